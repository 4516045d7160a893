"""The losses, the exposure and the densification against loops in float64, and a short training of the whole recipe."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import surfkit_pgsr
import torch
from surfkit_pgsr.densify import FewViews, TwoThresholdADC
from surfkit_pgsr.exposure import GainOffset
from surfkit_pgsr.losses import EdgeAwareNormal, MeanThickness, edges
from surfkit_pgsr.planes import PlanarGaussian

from surfkit.core.codec import dump, load
from surfkit.core.registry import plugins
from surfkit.core.schedule import LearningRate, rescale
from surfkit.densify import ADC, Elongation, LossGradient
from surfkit.plugin import (
    BadInput,
    Camera,
    Contribution,
    Maps,
    Points,
    Primitive,
    SparsePoints,
    Step,
    Target,
    View,
    components,
)
from surfkit.primitives import Surfel2D
from surfkit.primitives.init import SH_C0
from surfkit.raster.select import select
from surfkit.testing import check, check_policy
from surfkit.train.trainer import Trainer

N = 200
DUE = 700


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = PlanarGaussian in components(Primitive).values()
    if not there:
        plugins().register(surfkit_pgsr, "pgsr of this test")
    yield
    if not there:
        plugins().unregister(surfkit_pgsr)


def camera(x=0.0, width=14, height=11, focal=20.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def bumpy(seed=0) -> tuple[Maps, Target]:
    """A surface that is not flat, normals that are not its own, and a photograph, in float64."""
    draw = torch.Generator().manual_seed(seed)
    depth = 1 + 0.1 * torch.rand(11, 14, generator=draw).double()
    alpha = 0.5 + 0.5 * torch.rand(11, 14, generator=draw).double()
    depth[4, 5] = 0
    normal = torch.randn(3, 11, 14, generator=draw).double()
    photo = torch.rand(3, 11, 14, generator=draw).double()
    maps = Maps(photo, alpha, alpha * depth, depth, normal)
    return maps, Target(View("a", camera(), Path("a")), photo)


@pytest.mark.parametrize("power", [2.0, 5.0])
def test_the_normal_loss_is_that_of_a_loop(power):
    maps, target = bumpy()
    eye, depth, total, grads = target.view.camera, maps.median, 0.0, {}
    rays = eye.rays(torch.float64)
    points = rays * depth
    grey = target.photo.mean(0)
    for y in range(1, 10):
        for x in range(1, 13):
            across, down = (grey[y, x + 1] - grey[y, x - 1]) / 2, (grey[y + 1, x] - grey[y - 1, x]) / 2
            grads[y, x] = math.hypot(across, down)
    largest = max(grads.values())
    for (y, x), size in grads.items():
        if min(depth[y, x + 1], depth[y, x - 1], depth[y + 1, x], depth[y - 1, x]) <= 0:
            continue
        a, b = points[:, y, x + 1] - points[:, y, x - 1], points[:, y + 1, x] - points[:, y - 1, x]
        n = torch.linalg.cross(a, b)
        n = n / n.norm() * (-1 if n @ rays[:, y, x] > 0 else 1)
        apart = (maps.normal[:, y, x] - maps.alpha[y, x] * n).abs().sum()
        total += float((1 - size / largest) ** power * apart)
    found = EdgeAwareNormal(power=power)(maps, target)
    assert float(found) == pytest.approx(total / len(grads), rel=1e-9)


def test_the_normal_loss_of_a_plane_is_nothing_and_its_gradient_that_of_finite_differences():
    normal = torch.tensor([0.2, 0.1, -1.0]).double()
    normal /= normal.norm()
    maps, target = bumpy()
    depth = -1.2 / torch.einsum("c,chw->hw", normal, target.view.camera.rays(torch.float64))
    flat = replace(maps, depth=maps.alpha * depth, normal=maps.alpha * normal[:, None, None])
    assert float(EdgeAwareNormal()(flat, target)) < 1e-12
    way = torch.randn(11, 14, generator=torch.Generator().manual_seed(1)).double() * 1e-3
    way[4, 5] = 0  # no depth there, either way

    def loss(step: float):
        return EdgeAwareNormal()(replace(maps, depth=maps.depth + step * way), target)

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    slope = torch.autograd.grad(loss(step), step)[0]
    assert float(slope) == pytest.approx(float(loss(1e-5) - loss(-1e-5)) / 2e-5, rel=1e-4) and slope.abs() > 1e-6


def test_edges_lie_where_colours_change():
    photo = torch.zeros(3, 8, 10)
    photo[:, :, 5:] = 0.6
    found = edges(photo)
    assert torch.equal(found[0], torch.tensor([0, 0, 0, 1, 1, 0, 0, 0.0])) and not edges(torch.ones(3, 8, 10)).any()


def test_losses_and_exposure_keep_to_their_contracts():
    for part in (EdgeAwareNormal(start=0), MeanThickness(), GainOffset(start=0)):
        check(part)
    assert EdgeAwareNormal().weight_at(7_000, 30_000) == 0 and EdgeAwareNormal().weight_at(7_001, 30_000) == 0.015
    with pytest.raises(BadInput, match="power"):
        EdgeAwareNormal(power=-1)
    with pytest.raises(BadInput, match="thickness"):
        MeanThickness(weight=-1)


def test_exposure_is_one_gain_and_offset_and_is_folded_as_their_mean():
    draw, model = torch.Generator().manual_seed(0), GainOffset()
    color, numbers = torch.rand(3, 4, 5, generator=draw), torch.randn(7, 2, generator=draw) * 0.3
    assert torch.allclose(model(numbers[2], color, camera()), math.exp(numbers[2, 0]) * color + numbers[2, 1])
    params = {"sh0": torch.randn(9, 1, 3, generator=draw), "sh_rest": torch.randn(9, 3, 3, generator=draw)}
    basis = torch.randn(3, generator=draw)

    def shown(values):
        return 0.5 + SH_C0 * values["sh0"][:, 0] + (basis[:, None] * values["sh_rest"]).sum(1)

    wanted = numbers[:, 0].exp().mean() * shown(params) + numbers[:, 1].mean()
    assert torch.allclose(shown(model.folded(numbers, params)), wanted, atol=1e-5)
    assert [model.rate_at(at, 30_000) for at in (1, 1_000, 1_001)] == [0, 0, 1e-3]
    with pytest.raises(BadInput, match="rate is 0"):
        GainOffset(rate=0)


def crowd(seed=0) -> tuple[Points, Step]:
    """Points of all sizes and gradients, at a step at which they are densified."""
    draw = torch.Generator().manual_seed(seed)
    cloud = SparsePoints(torch.rand(N, 3, generator=draw), torch.zeros(N, 3, dtype=torch.uint8))
    params = Surfel2D().init(cloud, draw)
    params["scales"] = torch.log(10 ** (-1.5 - 2.5 * torch.rand(N, 2, generator=draw)))
    step = Step(
        index=DUE, steps=30_000, seen=torch.ones(N, dtype=torch.bool), splats=Surfel2D().activate(params, 0),
        grad_norm=1.6e-3 * torch.rand(N, generator=draw), radii=40 * torch.rand(N, generator=draw), image_px=100,
        views=None, signed_norm=4e-4 * torch.rand(N, generator=draw),
    )  # fmt: skip
    return Points.fresh(params), step


def edited(policy: TwoThresholdADC, points: Points, step: Step):
    policy.watch(points, step)
    return policy.edit(points, step)


def test_points_are_chosen_as_by_a_loop():
    points, step = crowd()
    edit = edited(TwoThresholdADC(), points, step)
    size, clones, splits = step.splats.scales.amax(-1), set(), set()
    for at in range(N):
        if step.signed_norm[at] >= 2e-4:
            (clones if size[at] <= 0.001 else splits).add(at)
        elif step.grad_norm[at] >= 8e-4 and step.radii[at] > 20:
            splits.add(at)
    assert set(edit.clone.nonzero()[:, 0].tolist()) == clones and len(clones) > 2
    assert set(edit.split.nonzero()[:, 0].tolist()) == splits
    large = [at for at in splits if step.signed_norm[at] < 2e-4]
    assert len(large) > 5 and any(size[at] <= 0.001 for at in large), "large on the screen, whatever the size"


def test_means_are_over_the_views_and_the_largest_radius_counts():
    points, step = crowd()
    policy, half = TwoThresholdADC(), torch.arange(N) % 2 == 0
    other = replace(step, index=DUE - 1, seen=half, radii=torch.where(half, 30.0, 0.0), grad_norm=step.grad_norm * half,
                    signed_norm=step.signed_norm * half)  # fmt: skip
    for at in range(DUE - 100, DUE - 1):  # before the window, what was large is forgotten
        policy.watch(points, replace(other, index=at, radii=torch.full((N,), 1e3 if at == DUE - 100 else 0.0)))
    policy.watch(points, other)
    edit = edited(policy, points, step)
    wanted = (step.signed_norm < 2e-4) & (step.grad_norm >= 8e-4) & ((step.radii > 20) | half)
    assert torch.equal(edit.split & (step.signed_norm < 2e-4), wanted) and wanted.sum() > 8


def test_no_more_than_asked_for_and_the_largest_first():
    points, step = crowd()
    whole = edited(TwoThresholdADC(), points, step)
    large = whole.split & (step.signed_norm < 2e-4)
    some = edited(TwoThresholdADC(most=3), points, step)
    kept = some.split & (step.signed_norm < 2e-4)
    assert kept.sum() == 3 and step.grad_norm[kept].min() >= step.grad_norm[large & ~kept].max()
    assert torch.equal(some.split & ~kept, whole.split & ~large)
    capped = edited(TwoThresholdADC(points=N + 4), points, step)
    assert capped.split.sum() + capped.clone.sum() == 4
    want = torch.maximum(step.signed_norm / 2e-4, step.grad_norm / 8e-4 * large)
    added = capped.split | capped.clone
    assert want[added].min() >= want[(whole.split | whole.clone) & ~added].max()
    none = edited(TwoThresholdADC(points=N - 10), points, step)
    assert not (none.split | none.clone).any()


def test_points_that_few_views_see_are_dropped_now_and_then():
    points, step = crowd()
    counts = torch.arange(N) % 5
    known = Contribution(torch.zeros(N), torch.zeros(N), counts * 3, counts)
    step = replace(step, views=SimpleNamespace(contributions=lambda: known))
    assert torch.equal(FewViews().edit(points, replace(step, index=2_000)).drop, (counts == 0) | (counts == 1))
    assert torch.equal(FewViews(views=4).edit(points, replace(step, index=2_000)).drop, counts < 4)
    at = [index for index in range(500, 20_000, 50) if FewViews().edit(points, replace(step, index=index)) is not None]
    assert at == list(range(1_000, 15_001, 1_000))


def test_densification_keeps_to_the_contract():
    points, step = crowd()
    quick = TwoThresholdADC(adc=ADC(small=0.001, threshold=1e-4), absolute=1e-4)
    check(quick)
    check_policy(replace(quick, adc=replace(quick.adc, filters=(Elongation(0.5),))), points, step)
    assert quick.limited(70).most_points == 70 and TwoThresholdADC().edits(900) == range(600, 901, 100)
    with pytest.raises(BadInput, match="signed_norm"):
        quick.watch(points, replace(step, signed_norm=None))
    check(FewViews(views=1_000))


@pytest.mark.parametrize(
    "part, setting",
    [(TwoThresholdADC, {"absolute": 0.0}), (TwoThresholdADC, {"radius_px": -1.0}), (TwoThresholdADC, {"most": -1}),
     (TwoThresholdADC, {"points": 0}), (FewViews, {"every": 0}), (FewViews, {"views": 0})],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(part, setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        part(**setting)


def test_the_recipe_is_whole_and_refuses_a_signed_signal():
    recipe = surfkit_pgsr.surfkit_recipes()["pgsr"]
    assert load(type(recipe), dump(recipe)) == recipe
    with pytest.raises(BadInput, match="abs-gradient"):
        replace(recipe, pretrain=replace(recipe.pretrain, signal=LossGradient())).refuse_unfit()
    short = rescale(recipe.pretrain, 200 / 30_000)
    assert short.losses["normal"].start < 60 and short.densify.adc.edits(200) and short.prune[0].until == 100
    assert surfkit_pgsr.surfkit_rows()["methods"][0].recipe == recipe


def wall(eye: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """A photograph (uint8) of a slanted wall with waves on it, and its depth, one exact ray a pixel."""
    rays, normal = eye.rays(torch.float64), torch.tensor([0.4, 0.0, -1.0]).double()
    z = (-1.0 - normal @ eye.centre) / torch.einsum("c,chw->hw", normal, rays)
    x, y = (eye.centre[k] + rays[k] * z for k in range(2))
    waves = [torch.sin(31 * x + 9 * y) + torch.sin(23 * y - 7 * x), torch.sin(37 * y + 5), torch.cos(29 * x - 19 * y)]
    return (127 + 55 * torch.stack(waves)).clamp(0, 255).to(torch.uint8), z


def test_a_short_training_finds_the_wall_and_drops_what_one_view_sees():
    draw, recipe = torch.Generator().manual_seed(3), surfkit_pgsr.surfkit_recipes()["pgsr"]
    cameras = [camera(x, 36, 27, 38.0) for x in (-0.1, 0.0, 0.1)]
    photos = [wall(eye)[0] for eye in cameras]
    views = [View(f"{at}", eye, Path(f"{at}")) for at, eye in enumerate(cameras)]
    stage, start = replace(rescale(recipe.pretrain, 0.01), steps=66), {"start": 30}
    later = {name: replace(stage.losses[name], **start) for name in ("normal", "reprojection", "patches")}
    later["patches"] = replace(later["patches"], pixels=200)
    adc = replace(stage.densify.adc, start=20, every=20, until=60, small=0.05)
    stage = replace(
        stage, losses=stage.losses | later, densify=replace(stage.densify, adc=adc, points=400, radius_px=3.0),
        prune=(FewViews(start=10, until=50, every=40),), rates={"scales": LearningRate(0.02)},
    )  # fmt: skip
    xy = torch.rand(250, 2, generator=draw) * torch.tensor([1.3, 0.9]) - torch.tensor([0.65, 0.45])
    depth = 1 + 0.4 * xy[:, :1] + 0.03 * torch.randn(250, 1, generator=draw)
    alone = torch.tensor([[-1.4, 0.0, 2.7]])  # beyond the rim of all views but one
    cloud = SparsePoints(torch.cat([torch.cat([xy, depth], 1), alone]), torch.full((251, 3), 127, dtype=torch.uint8))
    params = recipe.primitive.init(cloud, draw)
    params["scales"][-1] = math.log(0.02)
    began = {name: value.clone() for name, value in params.items()}
    began["opacities"] += 5  # opaque, to be seen
    trainer = Trainer(stage, recipe.primitive, views, photos, select("cpu")[0])
    state = trainer.begin(Points.fresh(params), draw)
    done = list(trainer.run(state))
    first, last = (sum(d.losses["l1"] for d in part) / 9 for part in (done[:9], done[-9:]))
    assert last < 0.7 * first and set(done[-1].losses) == {*stage.losses, "thickness"}
    assert max(d.points for d in done) > 300 and len(state.points) <= 400
    shape = recipe.primitive.activate(state.points.params, 0).detached()
    ratio = shape.scales.amin(1) / shape.scales.amax(1)
    assert ratio.median() < 0.5, "they become flat"
    assert not (shape.means[:, 2] > 2).any(), "the point that one view sees is gone"
    before, after = (
        wrong(recipe.primitive.activate(values, 0).detached(), cameras) for values in (began, state.points.params)
    )
    assert after < 0.2 * before and after < 0.04, (before, after)


def wrong(splats, cameras) -> float:
    """Median error of the depth of the wall, as a share of it."""
    errors = []
    for eye in cameras:
        median = PlanarGaussian().render(splats, eye, select("cpu")[0], 0.005).maps.median
        errors.append((median / wall(eye)[1] - 1).abs()[median > 0])
    return float(torch.cat(errors).median())
