"""Square cells, and views by sparse points, against the rules written out view by view in numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.partition import ContractedGrid, QuantileGrid, SparsePointShare, SquareGrid
from surfkit.partition.plan import BlockMinimums, plan, thinned
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe
from surfkit.scene.observations import Observations, Observations2D
from surfkit.scene.scene import Frame, View
from surfkit.testing.inputs import above, coarse_model
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.stage import Stage


def under(places, **more):
    """The city under cameras at these places."""
    views = [View(f"{i:04}.png", above(*at), path=None) for i, at in enumerate(places)]
    return replace(coarse_model(200), views=views, **more)


def test_cells_are_squares_over_the_padded_box():
    """Cameras on 6 x 4 m, a fifth more is 7.2 x 4.8 m: of 2 m that is 4 x 3 squares around the middle (3, 2)."""
    places = np.random.default_rng(0).uniform(0, 1, (40, 2)) * [6, 4]
    places = np.concatenate([places, [[0, 0], [6, 4]]])
    frame = Frame(np.zeros(3), scale=0.5, metres=3.0)  # a unit is 3 m, of which 2 make a local unit: 6 m
    cells = SquareGrid(side=2.0).cells(under(places / 6, frame=frame))
    sides = np.array(cells.boxes, float) * 6
    assert cells.count == 12
    assert np.allclose(np.unique(sides[:, 0][~np.isnan(sides[:, 0])]), [1, 3, 5])
    assert np.allclose(np.unique(sides[:, 1][~np.isnan(sides[:, 1])]), [1, 3])
    at = np.stack([np.clip((places[:, 0] + 1) // 2, 0, 3), np.clip((places[:, 1] + 1) // 2, 0, 2)], 1)
    owner = cells.owner(torch.tensor(np.c_[places / 6, np.zeros(len(places))]))
    assert owner.tolist() == (at[:, 1] * 4 + at[:, 0]).astype(int).tolist()


def test_without_metres_the_longer_side_has_as_many_cells_as_asked_for():
    places = [(0.0, 0.0), (1.0, 0.0), (1.0, 0.45), (0.3, 0.2)]
    boxes = SquareGrid(across=5).cells(under(places)).boxes  # 1.2 / 5 = 0.24; 0.54 / 0.24 = 2.25, so 3 rows
    assert len(boxes) == 15
    assert boxes[6] == pytest.approx((0.5 - 0.36, 0.225 - 0.12, 0.5 - 0.12, 0.225 + 0.12))
    assert SquareGrid(across=1).cells(under(places)).count == 1
    line = [(0.1 * i, 0.0) for i in range(8)]
    assert SquareGrid(across=4).cells(under(line)).count == 4, "cameras in a line are cut along it"


def test_lengths_that_do_not_fit():
    with pytest.raises(BadInput, match="square-grid.side: .*100 m .*--metres-per-unit"):
        SquareGrid(side=100.0).refuse_unfit(Frame(np.zeros(3), 1.0))
    SquareGrid(side=100.0).refuse_unfit(Frame(np.zeros(3), 1.0, metres=2.0))
    SquareGrid().refuse_unfit(Frame(np.zeros(3), 1.0))
    tiny = under([(0.0, 0.0), (1.0, 1.0)], frame=Frame(np.zeros(3), 1.0, metres=1.0))
    with pytest.raises(BadInput, match="side 0.001 .*1,200 x 1,200.* 10,000"):
        SquareGrid(side=0.001).cells(tiny)
    with pytest.raises(BadInput, match="stand in one place"):
        SquareGrid().cells(under([(0.5, 0.5)] * 4))
    for make in (
        lambda: SquareGrid(side=0.0),
        lambda: SquareGrid(across=0),
        lambda: SquareGrid(padding=-0.1),
        lambda: SparsePointShare(points=-1),
        lambda: SparsePointShare(growth=0.5),
        lambda: SparsePointShare(chance=1.1),
        lambda: SparsePointShare(few=-1),
        lambda: SparsePointShare(share=-1.0),
        lambda: SparsePointShare(most=0),
    ):
        with pytest.raises(BadInput):
            make()


def random_scene(views: int, seed: int = 0, **more):
    """Views of random places that show random sparse points around a place near theirs, some of them twice."""
    draws = np.random.default_rng(seed)
    cameras = draws.uniform(-1, 1, (views, 2))
    xyz = np.c_[draws.uniform(-1, 1, (4_000, 2)), np.zeros(4_000)]
    seen = {}
    for i in range(views):
        middle, wide = cameras[i] + draws.normal(size=2) * 0.3, draws.choice([0.05, 0.2, 0.4])
        rows = np.flatnonzero((np.abs(xyz[:, :2] - middle) < wide).all(1))
        rows = draws.permutation(rows)
        seen[f"{i:04}.png"] = Observations2D(
            np.concatenate([rows, rows[:3]]), np.zeros((len(rows) + min(3, len(rows)), 2))
        )
    observations = Observations(xyz, np.zeros(len(xyz)), seen)
    return under(cameras.tolist(), observations=observations, **more)


def probabilities(sight, cells, rule):
    """The rule as it is written, one view and one block at a time."""
    found, cameras = sight.observations, sight.centres.numpy()[:, :2]
    low, high = cameras.min(0), cameras.max(0)
    chances = np.zeros((len(sight.views), cells.count))
    for v, view in enumerate(sight.views):
        points = found.xyz[sorted(set(found.seen[view.name].points.tolist()))][:, :2]
        for b, box in enumerate(cells.boxes):
            at = [np.nan if side is None else side for side in box]
            ends = [-np.inf, -np.inf, np.inf, np.inf]
            x0, y0, x1, y1 = (end if side is None else side for side, end in zip(box, ends, strict=True))
            count = sum(x0 <= x < x1 and y0 <= y < y1 for x, y in points)
            x, y = cameras[v]
            wide = (high[0] if box[2] is None else at[2]) - (low[0] if box[0] is None else at[0])
            tall = (high[1] if box[3] is None else at[3]) - (low[1] if box[1] is None else at[1])
            if x0 <= x < x1 and y0 <= y < y1 and count > rule.points:
                chances[v, b] = 1
            elif x0 - wide / 2 <= x <= x1 + wide / 2 and y0 - tall / 2 <= y <= y1 + tall / 2 and count > rule.points:
                chances[v, b] = rule.chance
            elif count > rule.few:
                chances[v, b] = min(1, rule.share * count / len(points))
    return chances


@pytest.mark.parametrize("few", [10, 60])
def test_views_join_by_the_rule(few):
    """What is sure joins, what is excluded does not, and what is left to chance joins as often as it should."""
    sight, rule = random_scene(120), SparsePointShare(few=few)
    cells = SquareGrid(across=4, padding=0.0).cells(sight)
    chances, times = probabilities(sight, cells, rule), 100
    joined = sum(rule.joins(replace(sight, seed=seed), cells).numpy().astype(float) for seed in range(times))
    assert (joined[chances == 1] == times).all() and (joined[chances == 0] == 0).all()
    open_ = (chances > 0) & (chances < 1)
    kinds = [chances == 1, chances == 0.5, open_ & (chances != 0.5), chances == 0]
    assert all(kind.sum() > 10 for kind in kinds), "each case of the rule occurs"
    off = (joined[open_] / times - chances[open_]) / np.sqrt(chances[open_] * (1 - chances[open_]) / times)
    assert np.abs(off).max() < 5 and abs(off.mean()) < 5 / np.sqrt(len(off)), "standard deviations"


def test_the_same_seed_draws_the_same_views():
    sight = random_scene(60)
    cells = SquareGrid(across=3).cells(sight)
    first, again, other = (SparsePointShare().joins(replace(sight, seed=seed), cells) for seed in (7, 7, 8))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_other_cells_too():
    """Cells in contracted space, and a block of several cells: with a camera inside, the points decide."""
    sight, rule = random_scene(60), SparsePointShare(points=20, few=20)
    for cells in (ContractedGrid((2, 2)).cells(sight), QuantileGrid((3, 1)).cells(sight)):
        joins = rule.joins(sight, cells)
        for v, view in enumerate(sight.views):
            rows = np.unique(sight.observations.seen[view.name].points)
            owner = cells.owner(torch.from_numpy(sight.observations.xyz[rows]))
            own = int(cells.owner(sight.centres[v : v + 1]))
            if int((owner == own).sum()) > 20:
                assert joins[v, own]
    cells = QuantileGrid((3, 1)).cells(sight)
    whole = rule.joins(sight, replace(cells, blocks=(0, 0, 0)))[:, 0]
    assert whole.tolist() == [len(np.unique(seen.points)) > 20 for seen in sight.observations.seen.values()]


def test_of_too_many_views_some_are_left_out_by_chance():
    joins = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) < torch.tensor([0.9, 0.1, 0.5])
    kept = thinned(joins, 100, seed=3)
    assert kept.sum(0).tolist() == [100, int(joins[:, 1].sum()), 100] and (kept <= joins).all()
    assert torch.equal(kept[:, 1], joins[:, 1])
    assert torch.equal(kept, thinned(joins, 100, seed=3)) and not torch.equal(kept, thinned(joins, 100, seed=4))
    often = sum(thinned(joins, 100, seed).float() for seed in range(400))[:, 0][joins[:, 0]] / 400
    share = 100 / int(joins[:, 0].sum())
    assert float((often - share).abs().max()) < 5 * (share * (1 - share) / 400) ** 0.5, "each as likely as the others"


def test_a_plan_keeps_to_the_limit_and_the_seed():
    sight = random_scene(200)
    made = plan(sight, SquareGrid(), SparsePointShare(most=30), BlockMinimums(views=20))
    assert all(20 <= len(block.views) <= 30 and block.cameras <= len(block.views) for block in made.blocks)
    assert sum(block.points for block in made.blocks) == len(sight.splats)
    again, other = (
        plan(replace(sight, seed=s), SquareGrid(), SparsePointShare(most=30), BlockMinimums(20)) for s in (0, 1)
    )
    assert again == made and other != made


def test_a_data_set_without_observations_is_refused_before_it_is_trained(tmp_path):
    truth = photograph(Flight(views=8, width=32, height=24, points=200))
    stage = Stage(steps=4)
    recipe = Recipe(pretrain=stage, partition=SquareGrid(), assign=SparsePointShare(points=5, few=1), tune=stage)
    write_colmap(tmp_path / "without", truth)
    with pytest.raises(BadInput, match="without: assign sparse-points .*none"):
        run(recipe, Data(tmp_path / "without"), tmp_path / "run", Compute("cpu"))
    assert not (tmp_path / "run" / "pretrain").exists()
    with pytest.raises(BadInput, match="100 m cannot be used"):
        run(replace(recipe, partition=SquareGrid(side=100.0)), Data(tmp_path / "without"), tmp_path / "run")
    write_colmap(tmp_path / "with", truth, tracks=True)
    run(recipe, Data(tmp_path / "with"), tmp_path / "run", Compute("cpu"))
    assert (tmp_path / "run" / "tune" / "checkpoint.safetensors").exists()
