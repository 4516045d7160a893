"""Training: the mesh comes nearer to a ball, an interruption changes nothing, and what does not fit is refused."""

from dataclasses import replace

import numpy as np
import pytest
import surfkit_milo
import torch
from surfkit_milo import MILO, MeshInTheLoop, Pivoted, PivotMesh, PivotValues
from surfkit_milo.loop import COUNT, DUE, SUM, USED, triangulated
from surfkit_milo.pivots import PIVOTS, Boxes, crossings, tetrahedra, vertices

from surfkit.core.registry import plugins
from surfkit.plugin import (
    BadInput,
    LearningRate,
    Points,
    Regularizer,
    Splats,
    Stage,
    Trainer,
    checkpoint,
    components,
    dump,
    load,
    rescale,
)
from surfkit.primitives.edit import Edit, apply
from surfkit.raster.select import select
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check, check_component, check_policy
from surfkit.testing.inputs import BALL_RADIUS, cloud, crowd, mesh_input, splats

PRIMITIVE = Pivoted(sh_degree=0)
MESH = MeshInTheLoop(watch=0, start=14, until=60, refresh=14, depth=2.0, normal=0.05)
STAGE = Stage(
    steps=60,
    regularizers={"mesh": MESH},
    densify=None,
    prune=(PivotValues(),),
    rates={"means": LearningRate(1e-3), "occupancies": LearningRate(0.02), "sh0": LearningRate(0.0)},
)


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = MeshInTheLoop in components(Regularizer).values()
    if not there:
        plugins().register(surfkit_milo, "milo of this test")
    yield
    if not there:
        plugins().unregister(surfkit_milo)


@pytest.fixture(scope="module")
def ball():
    return mesh_input("gaussian", count=500, views=14)


def begun(ball, stage=STAGE) -> tuple[Trainer, object]:
    """A trainer, and the state in which the Gaussians of the ball are scattered about it."""
    draw = torch.Generator().manual_seed(0)
    given, count = ball.splats, len(ball.splats)
    params = {
        "means": given.means + 0.006 * torch.randn(count, 3, generator=draw),
        "scales": given.scales.log(),
        "quats": given.quats,
        "opacities": torch.logit(given.opacities),
        "sh0": given.sh[:, :1] * (0.5 + torch.rand(count, 1, 1, generator=draw)),
        "sh_rest": torch.zeros(count, 0, 3),
        "occupancies": torch.zeros(count, PIVOTS),
        "spread": torch.zeros(count),
    }
    photos = [ball.photo(at) for at in range(len(ball.views))]
    trainer = Trainer(stage, PRIMITIVE, ball.views, photos, select("cpu")[0])
    params = {name: value.clone() for name, value in params.items()}
    return trainer, trainer.begin(Points.fresh(params), draw)


def off(state) -> float:
    """Mean distance of the vertices of the mesh from the ball, local units."""
    now = PRIMITIVE.activate(state.points.params, 0)
    spread = now.extra["spread"]
    boxes = Boxes.of(now, spread, (spread > 0).nonzero()[:, 0]).double()
    ends = crossings(tetrahedra(boxes.places().view(-1, 3)), boxes, 1.0)
    return float((vertices(boxes, torch.from_numpy(ends).view(-1, 2)).norm(dim=1) - BALL_RADIUS).abs().mean())


def trained(ball, stage=STAGE) -> tuple[list[float], Points, list[dict[str, float]]]:
    """Distances of the mesh when it is made and at the end, the points, and the losses of all steps."""
    trainer, state = begun(ball, stage)
    away, losses = [], []
    for done in trainer.run(state):
        losses.append(done.losses)
        if done.index in (MESH.start, stage.steps):
            away.append(off(state))
    return away, state.points, losses


@pytest.fixture(scope="module")
def whole(ball):
    return trained(ball)


def test_training_brings_the_mesh_of_a_ball_nearer_to_it(ball, whole):
    away, points, losses = whole
    assert (points.params["spread"] > 0).float().mean() > 0.8
    assert away[1] < 0.9 * away[0]
    alone, _, _ = trained(ball, replace(STAGE, regularizers={"mesh": replace(MESH, depth=0.0, normal=0.0)}))
    assert alone[0] == away[0] and away[1] < alone[1], "it is the mesh in the loop that does it"
    assert all("mesh" in each for each in losses) and losses[MESH.start]["mesh"] > losses[MESH.start - 1]["mesh"]


@pytest.mark.parametrize("stop", [9, 14, 33])
def test_an_interruption_changes_no_bits(stop, ball, whole, tmp_path):
    trainer, state = begun(ball)
    for done in trainer.run(state):
        if done.index == stop:
            break
    checkpoint.save(tmp_path / "state.safetensors", state)
    again = checkpoint.load(tmp_path / "state.safetensors")
    list(trainer.run(again))
    for name, value in whole[1].params.items():
        assert torch.equal(value, again.points.params[name]), name


def test_points_that_are_dropped_leave_the_tetrahedra(whole):
    points = whole[1]
    drop = torch.arange(len(points)) % 5 == 0
    after = apply(PRIMITIVE, points, Edit(drop=drop), torch.Generator())

    class Given:
        stat = staticmethod(after.stat)

    tets = triangulated(Given)
    assert len(tets) and tets.max() < PIVOTS * int((after.stat(USED) > 0).sum())
    assert int((after.stat(USED) > 0).sum()) == int((points.stat(USED)[~drop] > 0).sum())


def test_of_too_many_gaussians_some_are_drawn_and_their_boxes_enlarged(ball):
    term = replace(MESH, limit=100)
    trainer, state = begun(ball, replace(STAGE, steps=28, regularizers={"mesh": term}))
    for done in trainer.run(state):
        if done.index == 14:
            chosen, near = state.points.stat("milo/chosen").clone(), state.points.stat("milo/near")
            assert int((chosen > 0).sum()) == 100
            factor = (int((near > 0).sum()) / 100) ** (1 / 3)
            assert torch.allclose(chosen[chosen > 0], torch.tensor(factor)), "by the third root"
            assert not state.points.params["spread"].any(), "larger boxes are observed first"
    assert torch.equal(state.points.params["spread"] > 0, chosen > 0)


def pivoted(count: int = 40) -> Splats:
    draw = torch.Generator().manual_seed(0)
    extra = {"occupancies": torch.randn(count, PIVOTS, generator=draw), "spread": torch.ones(count)}
    return replace(splats("gaussian", count), extra=extra)


def test_the_parts_keep_to_the_contract(ball):
    check(PRIMITIVE)
    check_component(PivotValues())
    points = Points.fresh(PRIMITIVE.init(cloud(), torch.Generator().manual_seed(0)))
    count, step = len(points), replace(crowd()[1], splats=PRIMITIVE.activate(points.params, 0))
    for name, shape in {USED: (), SUM: (PIVOTS,), COUNT: (PIVOTS,)}.items():
        points.stat(name, *shape).fill_(1.0)
    points.stat(DUE).fill_(step.index)
    check_policy(PivotValues(), points, step)
    edit = PivotValues().edit(points, step)
    assert edit.values["spread"].tolist() == [1.0] * count
    sizes = Boxes.of(step.splats, torch.ones(count)).sizes
    assert torch.allclose(edit.values["occupancies"], (1 / sizes)[:, None].expand(-1, PIVOTS))
    assert PivotValues().edit(points, replace(step, index=step.index + 1)) is None
    check(MeshInTheLoop(watch=0, start=999, until=30_000, refresh=1), pivoted())
    blank = {"occupancies": torch.zeros(len(ball.splats), PIVOTS), "spread": torch.ones(len(ball.splats))}
    known = replace(ball.splats, extra=blank)
    boxes = Boxes.of(known, torch.ones(len(known)))
    blank["occupancies"] = (boxes.places().norm(dim=2) - BALL_RADIUS) / boxes.sizes[:, None]
    check(PivotMesh(), replace(ball, splats=replace(known, extra=blank)))


def test_what_does_not_fit_is_refused(ball):
    trainer, state = begun(ball, replace(STAGE, prune=()))
    with pytest.raises(BadInput, match="prune.0:pivot-values"):
        list(trainer.run(state))
    with pytest.raises(BadInput, match="primitive:pivoted"):
        MESH(ball.splats)
    for setting in ({"depth": -1.0}, {"refresh": 0}, {"limit": 0}, {"start": 3}, {"until": 0}, {"truncation": 0.0}):
        with pytest.raises(BadInput, match=next(iter(setting))):
            MeshInTheLoop(**setting)
    with pytest.raises(BadInput, match="longest"):
        PivotMesh(longest=-1.0)


def test_the_recipe_has_the_published_values_and_its_row():
    assert load(type(MILO), dump(MILO)) == MILO
    MILO.refuse_unfit()
    term = MILO.pretrain.regularizers["mesh"]
    assert (term.depth, term.normal, term.inside, term.labels) == (0.05, 0.05, 0.005, 0.005)
    assert (MILO.pretrain.steps, term.start, term.until, term.refresh, term.limit) == (
        18_000,
        8_000,
        18_000,
        500,
        600_000,
    )
    short = rescale(MILO.pretrain, 0.1).regularizers["mesh"]
    assert (short.watch, short.start, short.until, short.refresh) == (500, 800, 1_800, 50)
    assert build(offered_tables()["methods"])["MILo"].pretrain == MILO.pretrain
    assert np.all([term.weight_at(at, 18_000) == on for at, on in ((5_000, 0), (5_001, 1), (18_000, 1), (18_001, 0))])
