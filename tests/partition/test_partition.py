"""Cells, views and merging, on a flat city of discs seen from a grid of cameras."""

import math
from dataclasses import dataclass, replace

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.partition import (
    Airspace,
    Balanced,
    CameraGrid,
    Cells,
    ContractedGrid,
    Partition,
    PictureShare,
    QuantileGrid,
    SquareGrid,
    SSIMDifference,
)
from surfkit.partition.base import Contraction, Ground
from surfkit.partition.merge import Merge
from surfkit.partition.plan import BlockMinimums, PartitionPlan, plan, touching, with_enough
from surfkit.testing import check_partition
from surfkit.testing.inputs import above, coarse_model

FLAT = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))

WAYS = [ContractedGrid((3, 2)), QuantileGrid((3, 2)), CameraGrid((3, 2)), SquareGrid(across=3), Balanced(6)]


@pytest.mark.parametrize("way", WAYS, ids=lambda way: type(way).__name__)
def test_every_place_is_owned_once(way):
    """Random points near and far, and points exactly on the sides of the cells, counted cell by cell."""
    cells = way.cells(coarse_model())
    draws = torch.Generator().manual_seed(1)
    points = torch.randn(4_000, 3, generator=draws, dtype=torch.float64) * torch.logspace(-1, 4, 4_000)[:, None]
    if cells.contraction is None:
        corners = [(box[at] or 0.0, box[at + 1] or 0.0, 0.0) for box in cells.boxes for at in (0, 2)]
        points = torch.cat([points, torch.tensor(corners, dtype=torch.float64)])
    flat = cells.ground.flat(points)
    if cells.contraction is not None:
        flat = cells.contraction.contracted(flat)
    owners = torch.zeros(len(points), dtype=torch.int64)
    for x0, y0, x1, y1 in cells.boxes:
        big = float("inf")
        low = torch.tensor([-big if x0 is None else x0, -big if y0 is None else y0])
        high = torch.tensor([big if x1 is None else x1, big if y1 is None else y1])
        owners += ((flat >= low) & (flat < high)).all(1)
    assert (owners == 1).all()
    owner = cells.owner(points)
    assert owner.min() == 0 and owner.max() == cells.count - 1 == (8 if isinstance(way, SquareGrid) else 5)


def test_random_cells_tile_the_ground():
    """Hundreds of trees of cuts, with points on the cuts."""
    draws = torch.Generator().manual_seed(2)
    for _ in range(100):
        boxes, cuts = [(None, None, None, None)], []
        for _ in range(5):
            x0, y0, x1, y1 = boxes.pop(int(torch.randint(len(boxes), (), generator=draws)))
            axis, share = int(torch.randint(2, (), generator=draws)), float(torch.rand((), generator=draws))
            low, high = ((x0, x1), (y0, y1))[axis]
            low, high = -9.0 if low is None else low, 9.0 if high is None else high
            at = low + share * (high - low)
            boxes += [(x0, y0, at, y1), (at, y0, x1, y1)] if axis == 0 else [(x0, y0, x1, at), (x0, at, x1, y1)]
            cuts.append(at)
        grid = torch.tensor([-1e9, *cuts, 1e9], dtype=torch.float64)
        points = torch.cat([torch.cartesian_prod(grid, grid), torch.zeros(len(grid) ** 2, 1)], 1)
        cells = Cells(FLAT, tuple(boxes), tuple(range(6)))
        inside = torch.stack([in_box(points, box) for box in boxes])
        assert (inside.sum(0) == 1).all() and torch.equal(cells.owner(points), inside.long().argmax(0))


def in_box(points, box):
    """(N,) bool, by comparing with each side: lower ones belong to the cell, upper ones do not."""
    low, high = (
        torch.tensor([end if side is None else side for side in sides], dtype=torch.float64)
        for sides, end in ((box[:2], -math.inf), (box[2:], math.inf))
    )
    flat = points[:, :2].double()
    return ((flat >= low) & (flat < high)).all(1)


def test_points_that_are_no_numbers_have_no_owner():
    cells = Cells(FLAT, ((None, None, None, None),), (0,))
    assert cells.owner(torch.tensor([[0.0, 0, 0], [float("nan"), 0, 0], [float("inf"), 0, 0]])).tolist() == [0, -1, -1]


def test_contraction_as_written():
    """The box becomes the middle quarter; outside (2 - 1 / |x|) x / |x| with the largest coordinate as the norm."""
    contraction = Contraction((-2.0, 0.0), (2.0, 2.0))
    at = torch.tensor([[-2.0, 0.0], [2.0, 2.0], [0.0, 1.0], [4.0, 1.0], [0.0, 1e12], [-6.0, 4.0]], dtype=torch.float64)
    found = contraction.contracted(at)
    # (4, 1): x = (2, 0), 2 - 1/2 = 1.5. (-6, 4): x = (-3, 3), (2 - 1/3) (-1, 1).
    expected = [[0.25, 0.25], [0.75, 0.75], [0.5, 0.5], [0.5 + 1.5 / 4, 0.5], [0.5, 1.0], [0.5 - 5 / 12, 0.5 + 5 / 12]]
    assert torch.allclose(found, torch.tensor(expected, dtype=torch.float64), atol=1e-9)


def about_x(angle: float) -> torch.Tensor:
    """(3, 3) float64 turn about the first axis."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64)


def test_ground_of_a_tilted_flight():
    """Cameras in a plane that no axis follows; and nearly level ones, which are taken as level."""
    draws = torch.Generator().manual_seed(3)
    flat = torch.cat(
        [torch.randn(50, 2, generator=draws, dtype=torch.float64) * torch.tensor([3.0, 1.0]), torch.zeros(50, 1)], 1
    )
    angle = torch.tensor(0.9, dtype=torch.float64)
    turn = torch.tensor([[1, 0, 0], [0, angle.cos(), -angle.sin()], [0, angle.sin(), angle.cos()]], dtype=torch.float64)
    ground = Ground.under(flat @ turn.T, flat)
    assert torch.linalg.norm(ground.flat(flat @ turn.T), dim=1) == pytest.approx(torch.linalg.norm(flat, dim=1))
    angle = torch.tensor(0.2, dtype=torch.float64)
    slight = torch.tensor(
        [[1, 0, 0], [0, angle.cos(), -angle.sin()], [0, angle.sin(), angle.cos()]], dtype=torch.float64
    )
    assert Ground.under(flat @ slight.T, flat) == FLAT
    line = torch.tensor([[1.0, 2, 3]], dtype=torch.float64) * torch.arange(5)[:, None]
    assert Ground.under(line, flat) == FLAT


def test_the_ground_under_a_kite_is_that_of_the_points():
    """Cameras spread more in height than to one side; a twentieth of the points hangs far away in the sky."""
    generator = torch.Generator().manual_seed(3)
    cameras = torch.randn(30, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 0.3, 0.8])
    points = torch.randn(1_000, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.1])
    points[:45] += 50
    assert Ground.under(cameras, points) == FLAT
    steady = cameras * torch.tensor([1.0, 1.0, 0.01])
    assert Ground.under(steady, points[:, [0, 2, 1]]) == FLAT, "a flight at one height, past a wall"


def test_rows_of_equal_count():
    sight = coarse_model()
    cells = QuantileGrid((3, 1)).cells(sight)
    assert torch.bincount(cells.owner(sight.splats.means)).tolist() == [500, 500, 500]


def test_balanced_cells_share_the_work():
    """Work counted from the plan, not from the strips: the largest block against the mean."""
    sight = coarse_model()

    def unevenness(way):
        shares = [block.work for block in plan(sight, way, PictureShare(0.02), BlockMinimums(views=1)).blocks]
        return max(shares) * len(shares)

    assert unevenness(Balanced(6, threshold=0.02)) < 1.35 < unevenness(ContractedGrid((3, 2)))


def test_both_ways_to_assign_mostly_agree():
    sight = coarse_model()
    cells = QuantileGrid((2, 2)).cells(sight)
    owner = cells.owner(sight.splats.means)
    by_ssim = SSIMDifference().measure(sight, owner, 4)
    by_share = PictureShare().measure(sight, owner, 4)
    assert ((by_ssim > 0) <= (by_share > 0)).all(), "a block that shows nothing changes nothing"
    assert ((by_ssim > SSIMDifference().threshold) == (by_share > PictureShare().threshold)).float().mean() > 0.95
    whole = torch.stack(
        [sight.rasterizer.render(sight.splats, v.camera, 0.01, False).maps.alpha.mean() for v in sight.views]
    )
    assert torch.allclose(by_share.sum(1), whole, atol=1e-4)


def test_difference_is_that_of_the_pictures():
    """One view, one block, drawn by hand."""
    from surfkit.raster.ssim import ssim_reference

    sight = coarse_model(300)
    owner = (sight.splats.means[:, 0] > 0).long()
    found = SSIMDifference().measure(replace(sight, views=sight.views[14:15]), owner, 2)
    kept = owner == 0
    rest = replace(sight.splats, **{name: value[kept] for name, value in sight.splats.tensors().items()})
    pictures = [
        sight.rasterizer.render(s, sight.views[14].camera, 0.01, False).maps.color for s in (rest, sight.splats)
    ]
    assert found[0, 1].item() == pytest.approx(1 - float(ssim_reference(*pictures)), abs=1e-4)


def test_the_plan_names_everything_and_survives_a_file():
    sight = coarse_model()
    made = plan(sight, QuantileGrid((2, 2)), PictureShare())
    assert sum(block.points for block in made.blocks) == len(sight.splats)
    assert sum(block.cameras for block in made.blocks) == len(sight.views)
    assert sum(block.work for block in made.blocks) == pytest.approx(1)
    assert {name for block in made.blocks for name in block.views} == {view.name for view in sight.views}
    assert all(len(block.views) >= 2 for block in made.blocks)
    assert load(PartitionPlan, dump(made), "plan") == made


def test_blocks_with_few_views_join_the_neighbour_that_shares_them():
    """Three cells in a row; the middle one has one view, which it shares with the right one."""
    boxes = ((None, None, 0.0, None), (0.0, None, 1.0, None), (1.0, None, None, None))
    cells = Cells(FLAT, boxes, (0, 1, 2))
    joins = torch.tensor([[1, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 1], [0, 0, 1]]).bool()
    found, views, _ = with_enough(cells, joins, joins, 2, torch.zeros(3).bool())
    assert found.blocks == (0, 1, 1) and found.count == 2
    assert views.tolist() == [[True, False]] * 3 + [[False, True]] * 2
    assert with_enough(cells, joins, joins, 100, torch.zeros(3).bool())[0].blocks == (0, 0, 0)
    assert touching(cells) == {0: {1}, 1: {0, 2}, 2: {1}}


def test_blocks_with_hardly_any_points_join_too():
    boxes = ((None, None, 0.0, None), (0.0, None, 1.0, None), (1.0, None, None, None))
    cells = Cells(FLAT, boxes, (0, 1, 2))
    joins = torch.tensor([[1, 1, 0], [1, 1, 0], [0, 1, 1]]).bool()
    found, views, _ = with_enough(cells, joins, joins, 1, torch.tensor([False, True, False]))
    assert found.blocks == (0, 0, 1) and views.tolist() == [[True, False], [True, False], [True, True]]
    sight = coarse_model()
    far = replace(sight.splats, means=sight.splats.means.clone())
    far.means[0] = torch.tensor([40.0, 40.0, 0.0])
    lonely = Cells(FLAT, ((None, None, 20.0, None), (20.0, None, None, None)), (0, 1))
    made = plan(replace(sight, splats=far), Fixed(lonely), PictureShare())
    assert [block.points for block in made.blocks] == [len(far)]


@dataclass(frozen=True)
class Fixed(Partition):
    """Cells as given."""

    given: Cells

    def cells(self, sight):
        return self.given


def test_corners_do_not_touch():
    quarters = ((None, None, 0.0, 0.0), (0.0, None, None, 0.0), (None, 0.0, 0.0, None), (0.0, 0.0, None, None))
    cells = Cells(FLAT, quarters, (0, 1, 2, 3))
    assert touching(cells) == {0: {1, 2}, 1: {0, 3}, 2: {0, 3}, 3: {1, 2}}


def test_small_scenes_need_fewer_views():
    assert BlockMinimums().of(5_000, 16) == 50 and BlockMinimums().of(30, 4) == 2 and BlockMinimums().of(3, 8) == 1


def merged(cells, coarse, tuned, skipped=frozenset()):
    """All blocks as one, from pieces of 7 points; and what each gave."""

    def pieces(params):
        rows = range(0, len(params["means"]), 7)
        return lambda: ({name: value[at : at + 7] for name, value in params.items()} for at in rows)

    merge = Merge(cells, pieces(coarse), {index: pieces(params) for index, params in tuned.items()}, skipped)
    parts = list(merge.pieces())
    return {name: torch.cat([part[name] for part in parts]) for name in coarse}, merge.shares()


def test_merged_points_come_from_their_owner_once():
    sight = coarse_model()
    cells = QuantileGrid((2, 2)).cells(sight)
    draws = torch.Generator().manual_seed(4)
    tuned = {}
    for index in range(4):  # every block moves all it sees, and marks it
        means = sight.splats.means + 0.05 * torch.randn(len(sight.splats), 3, generator=draws)
        tuned[index] = {"means": means, "mark": torch.full((len(means),), index)}
    coarse = {"means": sight.splats.means, "mark": torch.full((len(sight.splats),), -1)}
    whole, shares = merged(cells, coarse, tuned)
    assert torch.equal(cells.owner(whole["means"]), whole["mark"])
    assert [share.kept for share in shares] == [int((cells.owner(t["means"]) == i).sum()) for i, t in tuned.items()]
    assert len(whole["mark"]) == sum(share.kept for share in shares) and not any(share.filled for share in shares)


def test_a_hole_is_refused_or_filled():
    sight = coarse_model()
    cells = QuantileGrid((2, 2)).cells(sight)
    coarse = {"means": sight.splats.means}
    tuned = {index: coarse for index in (0, 1, 3)}
    with pytest.raises(BadInput, match="blocks 2 are not tuned"):
        merged(cells, coarse, tuned)
    whole, shares = merged(cells, coarse, tuned, frozenset({2}))
    assert [share.filled for share in shares] == [False, False, True, False]
    assert torch.equal(whole["means"].sort(0).values, sight.splats.means.sort(0).values)


def test_bad_settings_and_scenes():
    for make in (
        lambda: QuantileGrid((0, 2)),
        lambda: CameraGrid((2, 0)),
        lambda: ContractedGrid((1, 1), foreground=(0.6, 0.0, 0.4, 1.0)),
        lambda: Balanced(0),
        lambda: SSIMDifference(1.5),
        lambda: Airspace(threshold=1.0),
        lambda: Airspace(growth=-0.1),
    ):
        with pytest.raises(BadInput):
            make()
    sight = coarse_model(40)
    with pytest.raises(BadInput, match="too few"):
        QuantileGrid((50, 1)).cells(sight)
    in_line = replace(sight, views=sight.views[:6])
    with pytest.raises(BadInput, match="quantile-grid"):
        ContractedGrid((2, 2)).cells(in_line)
    away = replace(sight, views=tuple(replace(v, camera=above(50.0 + i, 60.0)) for i, v in enumerate(sight.views)))
    assert plan(away, QuantileGrid((1, 1)), PictureShare()).blocks[0].cameras == len(sight.views)


def test_a_partition_with_a_gap_is_found():
    gap = Cells(FLAT, ((None, None, 0.0, None), (0.1, None, None, None)), (0, 1))
    with pytest.raises(AssertionError, match="no owner"):
        check_partition(Fixed(gap), coarse_model())
