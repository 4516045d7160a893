"""Which points are split for being large and alone, in scenes that are drawn; the loss on scales; a short training."""

from dataclasses import replace
from pathlib import Path

import pytest
import surfkit_metrogs
import torch
from surfkit_metrogs.densify import SparsityCompensation, density
from surfkit_metrogs.losses import LargeScale

from surfkit.core.registry import plugins
from surfkit.densify import Elongation, PointCap
from surfkit.plugin import (
    ADC,
    BadInput,
    Camera,
    CountCap,
    Densify,
    Gaussian3D,
    Points,
    SparsePoints,
    Splats,
    Stage,
    Step,
    Surfel2D,
    View,
    components,
    refuse_unfit_stage,
)
from surfkit.raster.select import select
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check, check_policy
from surfkit.testing.inputs import crowd
from surfkit.train.view_order import ViewContributions

DUE = 1_000
FEW, DENSE, LONE = slice(0, 4), slice(4, 404), 404
"""Points of the scene: four huge ones, a dense wall, and one that no view shows."""


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = SparsityCompensation in components(Densify).values()
    if not there:
        plugins().register(surfkit_metrogs, "metrogs of this test")
    yield
    if not there:
        plugins().unregister(surfkit_metrogs)


def view(x: float, name: str) -> View:
    """One that looks at a wall of 0.2 x 0.2 about (x, 0.1, 0), which fills a picture of 32 x 32 pixels."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-x, -0.1, 1.0])
    return View(name, Camera(pose, 150.0, 150.0, 16.0, 16.0, 32, 32), Path())


def walls() -> Splats:
    """Two walls of 0.2 x 0.2 in the plane z = 0: at x = 0 four points of the size of a wall, at x = 2 twenty by twenty
    small ones, 25 in each voxel of 0.05; and a point far from everything."""
    wide, fine = (torch.cartesian_prod(at, at) for at in ((torch.arange(2) + 0.5) / 10, (torch.arange(20) + 0.5) / 100))
    places = torch.cat([wide, fine + torch.tensor([2.0, 0.0]), torch.tensor([[9.0, 9.0]])])
    means = torch.cat([places, torch.zeros(len(places), 1)], 1)
    scales = torch.full((len(means), 2), 0.005)
    scales[FEW] = 0.04
    turn = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1)
    return Splats("surfel", means, turn, scales, torch.full((len(means),), 0.95), torch.zeros(len(means), 1, 3))


VIEWS = [view(0.1, "a"), view(0.11, "b"), *(view(2.1, f"{i}") for i in range(8))]


def scene(splats: Splats | None = None) -> tuple[Points, Step]:
    """The walls, seen by two and by eight views, at a step that is due; no gradient asks for anything."""
    splats = splats or walls()
    count, draw = len(splats), torch.Generator().manual_seed(0)
    params = Surfel2D().init(SparsePoints(splats.means, torch.zeros(count, 3, dtype=torch.uint8)), draw)
    none = torch.zeros(count)
    views = ViewContributions(VIEWS, select("cpu")[0], lambda: splats, 0.01)
    given = dict(index=DUE, splats=splats, views=views, seen=none > 0, grad_norm=none, radii=none, signed_norm=none)
    return Points.fresh(params), replace(crowd()[1], **given)


def policy(**given) -> SparsityCompensation:
    return SparsityCompensation(**{"voxel": 0.05, **given})


def rows(mask: torch.Tensor) -> list[int]:
    return mask.nonzero()[:, 0].tolist()


def test_only_large_points_of_a_sparse_place_are_split():
    points, step = scene()
    area = step.views.leading()
    assert (area[FEW] > 20).all() and area[DENSE].max() > 20 and area[LONE] == 0, "the small ones are large enough"
    edit = policy().edit(points, step)
    assert rows(edit.split) == [0, 1, 2, 3] and not edit.clone.any() and not edit.drop.any()
    assert not ADC().edit(points, step).split.any()


def test_both_thresholds_are_respected():
    points, step = scene()
    area = step.views.leading()
    order = area[FEW].argsort(descending=True)
    assert len(set(area[FEW].tolist())) > 1
    most = int(area[FEW].max())
    assert rows(policy(area=most - 1).edit(points, step).split) == rows(area >= most)
    assert not policy(area=most).edit(points, step).split[order].any(), "S must be above S_th"
    assert rows(policy(crowd=2).edit(points, step).split) == [0, 1, 2, 3]
    assert not policy(crowd=1).edit(points, step).split.any(), "V must be below V_th, and a point counts itself"
    dense = policy(crowd=26).edit(points, step).split
    assert torch.equal(dense, area > 20), "now all are sparse"
    assert torch.equal(dense, policy(voxel=0.005).edit(points, step).split), "as in voxels of one point each"
    assert torch.equal(policy(crowd=25).edit(points, step).split, policy().edit(points, step).split)


def test_the_density_is_a_count_by_voxel():
    means = 4 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 2
    cells = [tuple(cell) for cell in (means / 0.5).floor().long().tolist()]
    assert density(means, 0.5).tolist() == [cells.count(cell) for cell in cells]
    assert len(set(cells)) > 100 and max(cells.count(cell) for cell in cells) > 2
    assert density(torch.tensor([[1e30, 0, 0], [0.1, 0, 0], [-1e30, 0, 0], [0.2, 0, 0]]), 1.0).tolist() == [1, 2, 1, 2]


@pytest.mark.parametrize("given", [{}, {"filters": (Elongation(),)}, {"filters": (CountCap(220),)}, {"until": 1_001}])
def test_without_large_points_it_is_adc(given):
    points, step = crowd()
    ours, adc = SparsityCompensation(area=1e9, **given), ADC(**given)
    for index in range(901, 1_001):
        ours.watch(points, replace(step, index=index))
    for index in (950, 1_000, 3_000):
        found, wanted = (each.edit(points, replace(step, index=index)) for each in (ours, adc))
        assert (found is None) == (wanted is None)
        if found is not None:
            assert found.max_opacity == wanted.max_opacity
            for name in ("drop", "clone", "split") if index == 1_000 else ():
                assert torch.equal(getattr(found, name), getattr(wanted, name)), name
    assert ours.edits(30_000) == adc.edits(30_000) and ours.most_points == adc.most_points


def hot(points: Points, step: Step, *at: int) -> Step:
    """The step after whose statistics ADC names some points."""
    norm = torch.zeros(len(step.splats))
    norm[list(at)] = 1e-3
    step = replace(step, grad_norm=norm, seen=torch.ones_like(norm, dtype=torch.bool))
    ADC().watch(points, step)
    return step


def test_what_adc_names_is_cloned_and_split_as_ever_and_what_both_name_is_split():
    points, step = scene()
    tiny = step.splats.scales.clone()
    step = hot(points, replace(step, splats=replace(step.splats, scales=tiny)), 1, 10, LONE)
    edit = policy(small=0.045).edit(points, step)
    assert rows(edit.clone) == [10, LONE] and rows(edit.split) == [0, 1, 2, 3], "1 is small for ADC, but sparse"
    assert rows(ADC(small=0.045).edit(points, step).clone) == [1, 10, LONE]
    assert rows(policy(small=0.004).edit(points, step).split) == [0, 1, 2, 3, 10, LONE]


def test_limits_hold_and_those_of_adc_come_first_then_the_largest():
    points, step = scene()
    count = len(step.splats)
    step = hot(points, step, 10, LONE)
    area = step.views.leading()
    first = area[FEW].argsort(descending=True, stable=True)
    for room in (0, 1, 2, 3, 4, 5, 6, 9):
        for capped in (policy(filters=(CountCap(count + room),)), policy().limited(count + room)):
            assert capped.most_points == count + room
            edit = capped.edit(points, step)
            named = rows(edit.clone | edit.split)
            assert len(named) == min(room, 6)
            assert set(named) <= {10, LONE} or {10, LONE} <= set(named)
            if 2 <= room < 6:
                left = area[FEW][first[room - 2 :]].max()
                assert all(area[row] >= left for row in named if row < 4)


def test_only_points_that_may_be_densified_are():
    points, step = scene()
    step = replace(step, owns=lambda means: means[:, 1] < 0.1)
    assert rows(policy().edit(points, step).split) == [0, 2]
    assert not policy().edit(points, replace(step, owns=lambda means: means[:, 0] > 1)).split.any()
    needles = replace(step.splats, scales=step.splats.scales * torch.tensor([1.0, 0.005]))
    assert not policy(filters=(Elongation(),)).edit(points, replace(step, splats=needles, owns=None)).split.any()


def test_views_are_drawn_anew_at_each_edit():
    points, step = scene()
    few = policy(views=3)
    assert policy()._drawn(step.views, 0) is None and policy(views=10)._drawn(step.views, 0) is None
    drawn = [few._drawn(step.views, seed) for seed in range(20)]
    assert all(len(set(one)) == 3 and max(one) < 10 for one in drawn) and len({tuple(one) for one in drawn}) > 5
    assert torch.equal(step.views.leading([0, 1]) + step.views.leading(range(2, 10)), step.views.leading())
    splits = [bool(few.edit(points, replace(step, seed=seed)).split.any()) for seed in range(20)]
    assert splits == [bool({0, 1} & set(one)) for one in drawn], "only two views show the sparse wall"


@pytest.mark.parametrize("densify", [SparsityCompensation(), PointCap(SparsityCompensation(), 500)])
def test_primitives_that_do_not_tell_are_refused_before_the_run(densify, monkeypatch):
    refuse_unfit_stage("pretrain", Stage(densify=densify), Surfel2D())
    monkeypatch.setattr(Surfel2D, "contribution", lambda self, *given: None)  # of something else than its points
    with pytest.raises(BadInput, match=r"pretrain.densify: .* asks which points lead in a pixel, .* does not tell"):
        refuse_unfit_stage("pretrain", Stage(densify=densify), Surfel2D())
    refuse_unfit_stage("pretrain", Stage(), Surfel2D())


@pytest.mark.parametrize("part", [SparsityCompensation(), SparsityCompensation(area=0, crowd=1_000), LargeScale()])
def test_the_parts_keep_the_contract(part):
    check(part)
    if isinstance(part, Densify):
        check_policy(part)
        assert not part.divides


def test_large_scales_cost():
    splats = walls()
    grown = splats.scales.clone().requires_grad_()
    loss = LargeScale(limit=0.01)(replace(splats, scales=grown))
    assert loss.item() == pytest.approx(4 * 0.03 / 405, rel=1e-5)
    loss.backward()
    assert rows(grown.grad.sum(1)) == [0, 1, 2, 3], "below the limit nothing pulls"
    assert LargeScale()(splats.first(0)).item() == 0 and LargeScale.only_seen


@pytest.mark.parametrize(
    ("kind", "given"),
    [(SparsityCompensation, {name: 0}) for name in ("crowd", "views", "voxel")]
    + [(SparsityCompensation, {"area": -1}), (SparsityCompensation, {"voxel": float("nan")})]
    + [(SparsityCompensation, {"every": 0}), (LargeScale, {"weight": -1}), (LargeScale, {"limit": float("nan")})],
)
def test_settings_that_mean_nothing_are_refused(kind, given):
    (name,) = given
    with pytest.raises(BadInput, match=f"{name} is .*; it must be"):
        kind(**given)


def test_rows_are_built_on_those_that_they_belong_to():
    tables = offered_tables()
    assert build(tables["methods"])["MetroGS"].pretrain == surfkit_metrogs.METROGS.pretrain
    densify = build(tables["densify"])[surfkit_metrogs.ROW]
    assert densify.pretrain.densify == SparsityCompensation() and isinstance(densify.primitive, Gaussian3D)
    surface = build(tables["surface"])
    row, below = surface[f"+ {surfkit_metrogs.ROW}"], surface["+ stereo depth as a loss"]
    assert row.pretrain.losses == below.pretrain.losses and row.depth == below.depth and row.start == below.start
    ours, adc = row.pretrain.densify, below.pretrain.densify
    assert {name: getattr(ours, name) for name in vars(adc)} == vars(adc), "they differ in eq. 5 alone"


def test_the_recipe_is_as_published():
    stage: Stage = surfkit_metrogs.METROGS.pretrain
    assert stage.steps == 30_000 and stage.densify.until == 15_000
    assert stage.losses["depth"].weight_at(1, 30_000) == pytest.approx(0.5, rel=1e-3)
    assert stage.losses["depth"].weight_at(30_000, 30_000) == pytest.approx(0.005)
    assert stage.losses["normal"].weight == 0.0125 and stage.regularizers["large"].weight == 0.1
    assert (stage.densify.area, stage.densify.crowd) == (20, 10)
    later = [refine.stage for refine in surfkit_metrogs.METROGS.refine]
    assert sum(one.steps for one in later) == 30_000 and not any(one.policies for one in later)
    for one in later:
        assert one.losses["normal"].weight == 0.0125 and {one.losses["depth"].weight_at(at, 9) for at in (1, 9)} == {
            2.5
        }
        assert not one.regularizers
    rates = [each for one in (stage, *later) for each in (one.rates["means"].start, one.rates["means"].end)]
    assert rates[0] == pytest.approx(1.6e-4) and rates[-1] == pytest.approx(1.6e-6)
    assert rates[1:-1:2] == pytest.approx(rates[2::2]), "positions go on at the rate that they had"
