"""The mask by finite differences through the drawn opacity, what pruning keeps, and a short training that goes on."""

from dataclasses import replace

import pytest
import surfkit_lp3dgs
import torch
from surfkit_lp3dgs.mask import DRAWN, MASK, MISSING, SCORE, MaskedAdam, gumbel_difference, gumbel_sigmoid
from surfkit_lp3dgs.prune import HIDDEN, LEAST_SCORE, PruneByMask, measured, relative

from surfkit.core.registry import plugins
from surfkit.plugin import (
    ADC,
    SIGMOID,
    BadInput,
    Column,
    Gaussian3D,
    LearningRate,
    Optimizer,
    OptimizerInput,
    Points,
    Stage,
    Trainer,
    checkpoint,
    components,
    refuse_unfit_stage,
    rescale,
)
from surfkit.raster.select import select
from surfkit.study.ablation import build, offered_tables
from surfkit.testing import check
from surfkit.testing.inputs import crowd, survey


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = MaskedAdam in components(Optimizer).values()
    if not there:
        plugins().register(surfkit_lp3dgs, "lp3dgs of this test")
    yield
    if not there:
        plugins().unregister(surfkit_lp3dgs)


@pytest.mark.parametrize("cls", [PruneByMask, MaskedAdam])
def test_the_parts_keep_to_the_contract_of_their_kind(cls):
    check(cls())


def test_the_gumbel_sigmoid_is_that_of_two_draws():
    """The two forms of the paper's equation, and the distribution of its noise."""
    product, g0, g1, tau = torch.rand(50).double(), torch.randn(50).double(), torch.randn(50).double(), 0.5
    top = ((product.log() + g0) / tau).exp()
    assert torch.allclose(gumbel_sigmoid(product, g0 - g1, tau), top / (top + (g1 / tau).exp()))
    noise = gumbel_difference(200_000, 3, product)
    draws = -(-torch.rand(2, 200_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64).log()).log()
    levels = torch.tensor([0.05, 0.3, 0.5, 0.9]).double()
    assert torch.allclose(noise.quantile(levels), (draws[0] - draws[1]).quantile(levels), atol=0.05)
    assert torch.equal(noise, gumbel_difference(200_000, 3, product))
    assert not torch.equal(noise, gumbel_difference(200_000, 4, product))
    # Without noise the mask is off where m S < 1, at any temperature.
    assert gumbel_sigmoid(torch.tensor([0.99, 1.01]), 0.0, 0.1).round().tolist() == [0, 1]


def points_of(logits: torch.Tensor) -> Points:
    count = len(logits)
    params = {"means": torch.zeros(count, 3).double(), "opacities": logits.clone()}
    return Points.fresh(params)


def told(index: int, seed: int, rates: dict[str, float]) -> OptimizerInput:
    return OptimizerInput(index, 100, rates, None, seed, None, None, None, None)


def test_gradients_by_opacity_and_mask_are_those_of_the_drawn_opacity(monkeypatch):
    """The optimizer is given the gradient of a loss by the logit of what was drawn; what it hands on must be that of
    the same loss by the logit without the mask, and by m, in float64."""
    draw = torch.Generator().manual_seed(0)
    logits, mask, score = (torch.rand(9, generator=draw, dtype=torch.float64) + shift for shift in (-0.5, 0.3, 0.2))
    score[8] = 0  # a point without importance is drawn as it is
    weights, optimizer, seed = torch.randn(9, generator=draw).double(), MaskedAdam(sparsity=0.7), 5
    points = points_of(logits)
    points.stat(MASK).copy_(mask)
    points.stat(SCORE).copy_(score)
    rates = {"opacities": 0.0}
    optimizer.step(points, {"opacities": torch.zeros(9).double()}, told(1, seed, rates))
    noise = gumbel_difference(9, seed, score)

    def loss(raw: torch.Tensor, m: torch.Tensor) -> torch.Tensor:
        factor = torch.where(score > 0, gumbel_sigmoid(m * score.clamp_min(1e-9), noise, optimizer.tau), 1)
        drawn = torch.sigmoid(raw) * factor
        return (weights * drawn**2).sum() + 0.7 * m[:8].abs().sum() / 8

    raw, m = logits.clone().requires_grad_(), mask.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, (raw, m))
    wanted = torch.autograd.grad(loss(raw, m), (raw, m))
    leaf = points.params["opacities"].clone().requires_grad_()
    factor = torch.where(score > 0, gumbel_sigmoid(mask * score, noise, optimizer.tau), 1)
    assert torch.allclose(torch.sigmoid(leaf), torch.sigmoid(logits) * factor)
    (grad,) = torch.autograd.grad((weights * torch.sigmoid(leaf) ** 2).sum(), leaf)
    learned = []
    monkeypatch.setattr(MaskedAdam, "_learn", lambda self, points, grad, masked: learned.append(grad * masked))
    found = optimizer._unmasked(points, points.stat(DRAWN), grad, 2)["opacities"]
    assert torch.allclose(found, wanted[0], rtol=1e-9) and torch.allclose(learned[0][:8], wanted[1][:8], rtol=1e-9)
    assert learned[0][8] == 0 and torch.allclose(points.params["opacities"], logits)


def test_masks_that_no_gradient_holds_fall_and_others_rise():
    points = points_of(torch.zeros(4).double())
    points.stat(MASK).fill_(3.0)
    points.stat(SCORE).fill_(1.0)
    optimizer = MaskedAdam(rate=0.02)
    for index in range(1, 52):
        grads = {"opacities": torch.tensor([0.0, 0.0, -1.0, -1.0]).double()}
        optimizer.step(points, grads, told(index, index, {"opacities": 0.0}))
    mask = points.stat(MASK)
    assert torch.allclose(mask[:2], torch.full((2,), 2.0).double(), atol=1e-3)  # 50 steps of the rate
    assert (mask[2:] > 3.3).all()
    points.stat(SCORE).zero_()
    optimizer.step(points, grads, told(52, 52, {"opacities": 0.0}))
    assert torch.allclose(points.params["opacities"], torch.zeros(4).double(), atol=1e-12)
    assert not points.stat(DRAWN).any() and not points.stat(MISSING).any()


def test_pruning_keeps_what_the_mask_says_and_importance_alone_does_not_matter():
    prune, (points, step) = PruneByMask(), crowd()
    points = replace(points, stats={})
    prune.watch(points, replace(step, index=19_499))
    assert not points.stats  # nothing is measured too early
    prune.watch(points, replace(step, index=19_500))
    assert (points.stat(MASK) == prune.begin).all() and (points.stat(SCORE) > 0).all()
    points.stat(MASK).copy_(torch.linspace(0.1, 3, len(points)).roll(7))
    prune.watch(points, replace(step, index=19_510))
    assert prune.edit(points, replace(step, index=19_999)) is None
    last = replace(step, index=20_000)
    expected = points.stat(MASK) * relative(measured(step.views, "peak"), torch.zeros(200), torch.zeros(200)) < 1
    prune.watch(points, last)
    drop = prune.edit(points, last).drop
    assert torch.equal(drop, expected) and 0 < drop.sum() < len(points)
    assert not points.stat(SCORE).any()
    assert prune.edit(points, replace(step, index=20_001)) is None


def test_importance_is_relative_to_the_median_and_not_lowered_by_the_mask():
    importance = torch.tensor([0.0, 1.0, 2.0, 4.0, 0.5])
    zeros = torch.zeros(5)
    assert torch.allclose(relative(importance, zeros, zeros), torch.tensor([LEAST_SCORE, 1, 2, 4, 0.5]))
    drawn = torch.tensor([0.0, 0.5, 1.0, 1.0, HIDDEN / 2])
    found = relative(importance, drawn, torch.full((5,), 7.0))
    assert torch.allclose(found * 2, torch.tensor([2 * LEAST_SCORE, 2.0, 2.0, 4.0, 14.0]))


def test_the_peak_of_a_view_is_between_the_largest_weight_and_a_little_more():
    """Of one point, whose weight in each pixel is its alpha, which the picture shows."""
    truth = survey(3, 32, 24, 150)
    raster, camera = select("cpu")[0], truth.scene.train[0].camera
    one = Gaussian3D(sh_degree=0).init(truth.scene.cloud, torch.Generator().manual_seed(0))
    _, hits = raster.contribution(Gaussian3D(sh_degree=0).activate(one, 0), camera, 0.005, 1, 1)
    at = int(hits.argmax())
    splats = Gaussian3D(sh_degree=0).activate({name: value[at : at + 1] for name, value in one.items()}, 0)
    alpha = raster.render(splats, camera, 0.005).maps.alpha
    amount, count = raster.contribution(splats, camera, 0.005, 16, 16)
    peak = float(amount[0] ** (1 / 16))
    assert alpha.max() > 0.02
    assert alpha.max() * 0.999 <= peak <= alpha.max() * float(count[0]) ** (1 / 16) * 1.001


def trained(stage: Stage, halfway=None):
    """Points after each step of a small survey; `halfway` may replace the state in the middle of the learning."""
    truth, primitive, draw = survey(6, 32, 24, 150), Gaussian3D(sh_degree=1), torch.Generator().manual_seed(0)
    photos = [(truth.exact[view.name].color * 255).round().to(torch.uint8) for view in truth.scene.train]
    trainer = Trainer(stage, primitive, truth.scene.train, photos, select("cpu")[0])
    state = trainer.begin(Points.fresh(primitive.init(truth.scene.cloud, draw)), draw)
    counts = []
    while state.index < stage.steps:
        trainer.step(state)
        counts.append(len(state.points))
        if halfway is not None and state.index == 20:
            state = halfway(state)
    return counts, state.points


def test_a_training_prunes_once_and_goes_on_from_the_middle_of_the_learning(tmp_path):
    prune = PruneByMask(start=10, length=30, every=10)
    stage = Stage(steps=50, densify=None, prune=(prune,), optimizer=MaskedAdam(rate=0.1))
    counts, points = trained(stage)
    assert len(set(counts[:39])) == 1 and counts[39] < counts[38] and len(set(counts[39:])) == 1
    assert not points.stat(MISSING).any()

    def again(state):
        assert state.points.stat(DRAWN).all()
        checkpoint.save(tmp_path / "checkpoint.safetensors", state)
        return checkpoint.load(tmp_path / "checkpoint.safetensors")

    other_counts, other = trained(stage, again)
    assert other_counts == counts
    assert all(torch.equal(value, other.params[name]) for name, value in points.params.items())


def test_the_recipe_has_both_parts_and_its_row_and_scales_with_the_steps():
    recipe = build(offered_tables()["methods"])["LP-3DGS"]
    assert recipe.pretrain == surfkit_lp3dgs.LP3DGS.pretrain
    refuse_unfit_stage("pretrain", recipe.pretrain, recipe.primitive)
    short = rescale(recipe, 400 / 30_000).pretrain
    refuse_unfit_stage("pretrain", short, recipe.primitive)
    assert (short.prune[0].start, short.prune[0].length) == (260, 100)
    for steps in (2, 20, 60, 100):
        refuse_unfit_stage("pretrain", rescale(recipe, steps / 30_000).pretrain, recipe.primitive)


def test_what_does_not_fit_is_refused(monkeypatch):
    both = Stage(prune=(PruneByMask(),), optimizer=MaskedAdam())
    wrong = [
        (replace(both, optimizer=Stage().optimizer), "masked-adam"),
        (replace(both, prune=()), "learned-mask"),
        (replace(both, steps=19_900), "the stage has 19900"),
        (replace(both, prune=(PruneByMask(), PruneByMask())), "twice"),
        (replace(both, densify=ADC(until=19_800)), "begin after"),
    ]
    for stage, message in wrong:
        with pytest.raises(BadInput, match=message):
            refuse_unfit_stage("pretrain", stage, Gaussian3D())
    columns = {**Gaussian3D().columns(), "opacities": Column((1,), LearningRate(0.1), SIGMOID)}
    with monkeypatch.context() as patch, pytest.raises(BadInput, match="one of each point"):
        patch.setattr(Gaussian3D, "columns", lambda self: columns)
        refuse_unfit_stage("pretrain", both, Gaussian3D())
    for cls, settings in [
        (MaskedAdam, {"tau": 0.0}),
        (MaskedAdam, {"rate": float("inf")}),
        (MaskedAdam, {"sparsity": -1.0}),
        (PruneByMask, {"every": 0}),
        (PruneByMask, {"start": 0}),
        (PruneByMask, {"begin": 0.0}),
    ]:
        with pytest.raises(BadInput):
            cls(**settings)
