"""The error of points, clones that leave the picture as it is, the growth, and trainings that are interrupted."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import surfkit_densify
import torch
from surfkit_densify.error import ERROR_STAT, ByError, shared_opacity

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.core.schedule import rescale
from surfkit.densify import Elongation, PointCap
from surfkit.plugin import (
    BadInput,
    Camera,
    CountCap,
    Densify,
    Gaussian3D,
    Points,
    SparsePoints,
    Splats,
    Stage,
    Surfel2D,
    Trainer,
    View,
    checkpoint,
    components,
    refuse_unfit_stage,
    ssim_map,
)
from surfkit.primitives.edit import apply
from surfkit.raster.reference import draw
from surfkit.raster.select import select
from surfkit.testing import check, check_policy
from surfkit.testing.inputs import crowd

DUE = 1_000


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = ByError in components(Densify).values()
    if not there:
        plugins().register(surfkit_densify, "densify of this test")
    yield
    if not there:
        plugins().unregister(surfkit_densify)


@dataclass(frozen=True)
class Photograph:
    """A view, and its picture, (3, H, W) uint8."""

    view: View
    photo: torch.Tensor


def photographs() -> list[Photograph]:
    """Two, of a pattern."""
    y, x = torch.meshgrid(torch.arange(24), torch.arange(32), indexing="ij")
    photo = (127 + 120 * torch.stack([torch.sin(x / 3), torch.sin(y / 4), torch.cos((x + y) / 5)])).to(torch.uint8)
    found = []
    for at in (-0.1, 0.1):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3], pose[2, 3] = -at, 1.0
        found.append(Photograph(View(f"{at}.png", Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24), Path()), photo))
    return found


def with_error(error: torch.Tensor, policy: ByError | None = None) -> tuple[Points, object, object]:
    """Points with an error, the step at which they are densified, and what is asked for there."""
    points, step = crowd(len(error))
    points.stat(ERROR_STAT).copy_(error)
    return points, step, (policy or ByError()).edit(points, replace(step, index=DUE))


@pytest.mark.parametrize("policy", [ByError(), ByError(corrected=False, lower_by=0), ByError(filters=(Elongation(),))])
def test_it_keeps_to_the_contract(policy):
    check(policy)
    check_policy(policy, *crowd())


def test_the_error_is_that_of_the_worst_view_since_the_last_edit():
    points, step = crowd()
    policy, view = ByError(), step.view
    share = view.blended(1 - ssim_map(view.color, view.photo).mean(0))
    other = replace(view, photo=view.color)
    assert share.max() > 0.1
    policy.watch(points, replace(step, index=901))
    policy.watch(points, replace(step, index=902, view=other))  # a better view changes nothing
    assert torch.equal(points.stat(ERROR_STAT), share)
    policy.watch(points, replace(step, index=1_001, view=other))  # the first after an edit
    assert points.stat(ERROR_STAT).max() < 1e-5
    late = ByError(until=950)
    late.watch(points, replace(step, index=960))
    assert points.stat(ERROR_STAT).max() < 1e-5
    with pytest.raises(BadInput, match="without `view`"):
        policy.watch(points, replace(step, view=None))


def test_at_most_a_twentieth_grows_and_the_worst_come_first():
    error = torch.rand(200, generator=torch.Generator().manual_seed(2)) + 0.2
    size = float(crowd()[1].splats.scales.amax(1).median())
    _, step, edit = with_error(error, ByError(small=size))
    grown = edit.clone | edit.split
    assert grown.sum() == 10 and error[grown].min() > error[~grown].max()
    assert edit.clone.any() and edit.split.any()
    assert torch.equal(edit.clone, grown & (step.splats.scales.amax(1) <= size))
    few = torch.where(torch.arange(200) < 4, error, 0.09)
    grown = with_error(few)[2]
    assert torch.equal(grown.clone | grown.split, torch.arange(200) < 4), "no others are above the threshold"
    _, _, capped = with_error(error, ByError(filters=(CountCap(203),)))
    assert int((capped.clone | capped.split).sum()) == 3
    _, _, none = with_error(torch.zeros(200))
    assert not none.clone.any() and not none.split.any()


def test_opacities_fall_by_a_constant_at_each_edit_and_only_then():
    points, step, edit = with_error(torch.zeros(200))
    assert torch.allclose(edit.opacities, step.splats.opacities - 0.001, atol=1e-6)
    assert ByError().edit(points, replace(step, index=DUE + 1)) is None
    _, _, still = with_error(torch.ones(200), ByError(lower_by=0.0, corrected=False))
    assert still.opacities.isnan().all()


def lone(opacity: float, double: bool) -> Splats:
    """One Gaussian, or two at the same place that have the opacity of its clones, float64."""
    count = 2 if double else 1
    one = torch.tensor([opacity], dtype=torch.float64)
    return Splats(
        "gaussian",
        torch.tensor([[0.0, 0, 2]], dtype=torch.float64).repeat(count, 1),
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(count, 1),
        torch.full((count, 3), 1e3, dtype=torch.float64),  # its alpha is the same over the whole picture
        (shared_opacity(one) if double else one).repeat(count),
        torch.ones(count, 1, 3, dtype=torch.float64),
    )


@pytest.mark.parametrize("opacity", [0.03, 0.4, 0.95])
def test_a_clone_does_not_change_what_is_seen(opacity):
    camera = Camera(torch.eye(4, dtype=torch.float64), 40.0, 40.0, 16.0, 12.0, 32, 24)
    with torch.no_grad():
        one, two = (draw(lone(opacity, double), camera, 0.01).maps for double in (False, True))
    assert abs(float(one.alpha.mean()) - opacity) < 1e-4
    assert torch.allclose(one.alpha, two.alpha, atol=1e-6) and torch.allclose(one.color, two.color, atol=1e-6)
    each = shared_opacity(torch.tensor(opacity, dtype=torch.float64))
    assert float(1 - (1 - each) ** 2) == pytest.approx(opacity, rel=1e-12)


@pytest.mark.parametrize("primitive", [Gaussian3D(sh_degree=1), Surfel2D(sh_degree=1)])
def test_an_edit_gives_both_copies_the_corrected_opacity(primitive):
    draw_ = torch.Generator().manual_seed(0)
    cloud = SparsePoints(torch.rand(50, 3, generator=draw_), torch.zeros(50, 3, dtype=torch.uint8))
    points = Points.fresh(primitive.init(cloud, draw_))
    _, step = crowd(50)
    step = replace(step, index=DUE, splats=primitive.activate(points.params, 0))
    points.stat(ERROR_STAT)[:2] = 1.0
    policy = ByError(lower_by=0.0, small=10.0)
    after = apply(primitive, points, policy.edit(points, step), draw_)
    before, now = step.splats.opacities, primitive.activate(after.params, 0).opacities
    assert len(after) == 52 and torch.allclose(now[[0, 1]], now[[50, 51]])
    assert torch.allclose(1 - (1 - now[:2]) ** 2, before[:2], atol=1e-6)
    assert torch.allclose(now[2:50], before[2:], atol=1e-6)


@pytest.mark.parametrize("steps", [20, 100, 600, 30_000])
def test_points_are_added_at_the_steps_that_are_foretold(steps):
    policy, (points, step) = rescale(ByError(), steps / 30_000), crowd()
    points.stat(ERROR_STAT).fill_(1.0)
    added = [i for i in range(1, steps + 1) if policy.edit(points, replace(step, index=i)) is not None]
    assert list(policy.edits(steps)) == added and len(added) >= 2


@pytest.mark.parametrize(
    "setting", [{"threshold": 0.0}, {"growth": -1.0}, {"lower_by": 1.0}, {"cull_opacity": -0.1}, {"every": 0}]
)
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        ByError(**setting)


@dataclass(frozen=True)
class Drawn(Surfel2D):
    """Draws itself."""

    def render(self, splats, camera, rasterizer, near, geometry=True, distortion=True):
        """As others."""
        return rasterizer.render(splats, camera, near, geometry, distortion)


def test_what_draws_itself_is_refused():
    class Offers:
        @hookimpl
        def surfkit_components(self):
            return {"drawn": Drawn}

    plugins().register(offers := Offers(), "drawn of this test")
    try:
        for densify in (ByError(), PointCap(inner=ByError())):
            with pytest.raises(BadInput, match=r"pretrain.densify: .* primitive drawn draws itself without them"):
                refuse_unfit_stage("pretrain", Stage(densify=densify), Drawn())
    finally:
        plugins().unregister(offers)
    refuse_unfit_stage("pretrain", Stage(densify=ByError()), Surfel2D())


def test_a_training_that_goes_on_gives_the_same_bits(tmp_path):
    draw_, (rasterizer, _), primitive = torch.Generator().manual_seed(3), select("cpu"), Gaussian3D(sh_degree=1)
    views, file = [each.view for each in photographs()], tmp_path / "c.safetensors"
    photos = [each.photo for each in photographs()]
    cloud = SparsePoints(0.6 * (torch.rand(60, 3, generator=draw_) - 0.5), torch.full((60, 3), 127, dtype=torch.uint8))
    stage = Stage(steps=40, densify=ByError(start=5, every=5, until=38))

    def begun():
        generator = torch.Generator().manual_seed(1)
        trainer = Trainer(stage, primitive, views, photos, rasterizer)
        return trainer, trainer.begin(Points.fresh(primitive.init(cloud, generator)), generator)

    trainer, whole = begun()
    list(trainer.run(whole))
    trainer, half = begun()
    for done in trainer.run(half):
        if done.index == 17:
            break
    checkpoint.save(file, half)
    again = checkpoint.load(file)
    assert len(again.points) > 60 and again.points.stat(ERROR_STAT).any(), "between two edits"
    list(trainer.run(again))
    assert len(half.points) < len(whole.points) == len(again.points)
    for name, value in whole.points.params.items():
        assert torch.equal(value, again.points.params[name]), name
