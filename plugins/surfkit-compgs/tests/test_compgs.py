"""Codes against means in numpy, the straight-through gradient against Adam without codes, and short trainings."""

from dataclasses import replace

import numpy as np
import pytest
import surfkit_compgs
import torch
from surfkit_compgs.codes import SIZES, CodedAdam, missing
from surfkit_compgs.opacity import OpacitySum

from surfkit.core.registry import plugins
from surfkit.plugin import (
    ADC,
    Adam,
    BadInput,
    Gaussian3D,
    Optimizer,
    OptimizerInput,
    Points,
    PruneByOpacity,
    SparsePoints,
    SplatModel,
    Stage,
    Trainer,
    Vectree,
    checkpoint,
    components,
    refuse_unfit_stage,
    rescale,
)
from surfkit.raster.select import select
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check
from surfkit.testing.inputs import splats, survey

COUNT = 60
OPTIMIZER = CodedAdam(colors=7, shapes=11, start=3, until=12, every=4)


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = CodedAdam in components(Optimizer).values()
    if not there:
        plugins().register(surfkit_compgs, "compgs of this test")
    yield
    if not there:
        plugins().unregister(surfkit_compgs)


@pytest.mark.parametrize("part", [CodedAdam(), replace(OPTIMIZER, colors=30, shapes=60), OpacitySum()])
def test_the_parts_keep_to_the_contract_of_their_kind(part):
    check(part)


def some_points(sh_degree: int = 1) -> Points:
    draw = torch.Generator().manual_seed(0)
    cloud = SparsePoints(torch.rand(COUNT, 3, generator=draw), torch.randint(256, (COUNT, 3), generator=draw).byte())
    params = Gaussian3D(sh_degree=sh_degree).init(cloud, draw)
    return Points.fresh(
        {name: value + 0.1 * torch.randn(value.shape, generator=draw) for name, value in params.items()}
    )


def taken(optimizer: Optimizer, points: Points, first: int, last: int) -> None:
    """Steps with gradients that depend on their index alone."""
    rates = {name: 0.01 for name in points.params}
    for index in range(first, last + 1):
        draw = torch.Generator().manual_seed(index)
        grads = {name: torch.randn(value.shape, generator=draw) for name, value in points.params.items()}
        optimizer.step(points, grads, OptimizerInput(index, 100, rates, None, index, None, None, None, None))


def whole(points: Points, name: str) -> torch.Tensor:
    """(N, D) a parameter without codes."""
    value = points.params[name]
    return (value + points.stats.get(missing(name), 0)).reshape(len(value), -1)


def rows(value: torch.Tensor) -> np.ndarray:
    return value.reshape(len(value), -1).numpy()


def test_the_straight_through_gradient_moves_what_is_not_quantised_as_adam_would():
    coded, plain = some_points(), some_points()
    taken(OPTIMIZER, coded, 1, 30)
    taken(Adam(), plain, 1, 30)
    for name, value in plain.params.items():
        assert torch.allclose(whole(coded, name), value.reshape(COUNT, -1), atol=2e-6), name
        assert torch.equal(coded.exp_avg[name], plain.exp_avg[name])
    for name in ("means", "opacities"):
        assert torch.equal(coded.params[name], plain.params[name])
    for name in SIZES:
        assert not torch.allclose(coded.params[name], plain.params[name], atol=1e-3)


def test_there_are_no_codes_before_their_time_and_no_more_than_so_many_from_then_on():
    points = some_points()
    taken(OPTIMIZER, points, 1, 3)
    assert all(len(np.unique(rows(points.params[name]), axis=0)) > 20 for name in SIZES)
    for index in range(4, 20):
        taken(OPTIMIZER, points, index, index)
        for name, setting in SIZES.items():
            found = np.unique(rows(points.params[name]), axis=0)
            assert 2 <= len(found) <= getattr(OPTIMIZER, setting), name


def test_colours_of_one_degree_need_no_codes_of_others():
    points = some_points(sh_degree=0)
    taken(OPTIMIZER, points, 1, 6)
    assert len(np.unique(rows(points.params["sh0"]), axis=0)) <= OPTIMIZER.colors
    assert points.params["sh_rest"].numel() == 0


def groups(points: Points, name: str) -> np.ndarray:
    """(N,) which points share a code, by the codes alone."""
    return np.unique(rows(points.params[name]), axis=0, return_inverse=True)[1].ravel()


def test_codes_are_the_means_of_their_points_after_every_step_and_points_choose_when_it_is_due():
    points = some_points()
    taken(OPTIMIZER, points, 1, 4)
    before = {name: groups(points, name) for name in SIZES}
    for index in range(5, 31):
        taken(OPTIMIZER, points, index, index)
        for name in SIZES:
            values, now = whole(points, name).double().numpy(), groups(points, name)
            if index == 8 or index == 12:  # start + 1, and every fourth from there, up to 12
                means = np.stack([values[before[name] == one].mean(0) for one in np.unique(before[name])])
                chosen = ((values[:, None] - means) ** 2).sum(-1).argmin(1)
                same = lambda one: one[:, None] == one  # noqa: E731 (only here)
                assert (same(chosen) == same(now)).all(), (name, index)
            else:
                assert ((now[:, None] == now) == (before[name][:, None] == before[name])).all(), (name, index)
            codes = np.stack([values[now == one].mean(0) for one in now])
            assert np.allclose(rows(points.params[name]), codes, atol=1e-6)
            before[name] = now


def test_new_points_choose_a_code_and_what_edits_change_is_not_undone():
    points = some_points()
    taken(OPTIMIZER, points, 1, 20)
    left = points.stats[missing("scales")].clone()
    points = points.append({name: value[:5] + 0.5 for name, value in points.params.items()})
    points.params["scales"][10] += 2.0
    frozen = {name: value.clone() for name, value in points.params.items()}
    still = {name: torch.zeros_like(value) for name, value in points.params.items()}
    rates = {name: 0.0 for name in points.params}
    OPTIMIZER.step(points, still, OptimizerInput(21, 100, rates, None, 21, None, None, None, None))
    for name, setting in SIZES.items():
        assert len(np.unique(rows(points.params[name]), axis=0)) <= getattr(OPTIMIZER, setting)
        expected = frozen[name].clone()
        if name == "scales":
            expected[:COUNT] += left
            assert torch.allclose(whole(points, name), expected, atol=1e-6)
    assert torch.equal(points.params["means"], frozen["means"])


def begun(stage: Stage):
    truth, primitive, draw = survey(6, 32, 24, 150), Gaussian3D(sh_degree=1), torch.Generator().manual_seed(0)
    photos = [(truth.exact[view.name].color * 255).round().to(torch.uint8) for view in truth.scene.train]
    trainer = Trainer(stage, primitive, truth.scene.train, photos, select("cpu")[0])
    return trainer, trainer.begin(Points.fresh(primitive.init(truth.scene.cloud, draw)), draw)


def test_a_training_with_edits_goes_on_from_a_checkpoint_and_the_model_has_so_many_codes(tmp_path):
    stage = Stage(
        steps=40,
        sh_every=5,
        densify=ADC(start=5, every=7, until=36, threshold=1e-6, reset_every=1_000),
        prune=(PruneByOpacity(start=10, until=30, every=5, below=0.05, recovery=0),),
        regularizers={"opacity": OpacitySum(weight=1e-3, start=10, until=20)},
        optimizer=replace(OPTIMIZER, start=20, until=30),
    )
    trainer, state = begun(stage)
    other = None
    while state.index < stage.steps:
        trainer.step(state)
        if state.index == 25:
            checkpoint.save(tmp_path / "checkpoint.safetensors", state)
            other = checkpoint.load(tmp_path / "checkpoint.safetensors")
    again = begun(stage)[0]
    list(again.run(other))
    assert len(state.points) == len(other.points) > 150
    assert all(torch.equal(value, other.points.params[name]) for name, value in state.points.params.items())
    left = stage.finished(state)
    for name, setting in SIZES.items():
        assert len(np.unique(rows(left[name]), axis=0)) <= getattr(OPTIMIZER, setting)
    # All that vectree does to colours that are codes is to round them to float16.
    model = SplatModel(Gaussian3D(sh_degree=1), left, 1)
    plan = Vectree(ratio=1.0, codes=7, codebooks="by-degree").plan(model, torch.ones(len(model)), 0)
    codes = np.unique(rows(left["sh0"]).astype(np.float16), axis=0)
    assert np.array_equal(plan.tables["sh.codes.0"], codes)


def test_the_sum_of_opacities_pulls_at_each_point_alike_in_its_steps():
    shape = splats(count=17)
    leaf = shape.opacities.detach().requires_grad_()
    OpacitySum()(replace(shape, opacities=leaf)).backward()
    assert torch.equal(leaf.grad, torch.ones(17))
    weights = [OpacitySum().weight_at(index, 30_000) for index in (15_000, 15_001, 20_000, 20_001)]
    assert weights == [0, 1e-7, 1e-7, 0]


def test_the_recipe_has_its_row_and_scales_with_the_steps():
    recipe = build(offered_tables()["methods"])["CompGS"]
    assert recipe.pretrain == surfkit_compgs.COMPGS.pretrain
    refuse_unfit_stage("pretrain", recipe.pretrain, recipe.primitive)
    short = rescale(recipe, 400 / 30_000).pretrain.optimizer
    assert (short.start, short.until, short.every, short.colors) == (267, 333, 20, 4_096)


@pytest.mark.parametrize(
    ("cls", "settings"),
    [
        (CodedAdam, {"colors": 0}),
        (CodedAdam, {"shapes": 1 << 30}),
        (CodedAdam, {"start": 10, "until": 9}),
        (CodedAdam, {"every": 0}),
        (OpacitySum, {"weight": float("nan")}),
        (OpacitySum, {"start": 10, "until": 9}),
    ],
)
def test_settings_that_mean_nothing_are_refused(cls, settings):
    with pytest.raises(BadInput):
        cls(**settings)


def test_a_stage_that_ends_before_there_are_codes_is_refused():
    with pytest.raises(BadInput, match="the stage has 20000"):
        refuse_unfit_stage("pretrain", Stage(steps=20_000, optimizer=CodedAdam()), Gaussian3D())
