"""Two processes that train one model, against one that has all of it."""

from dataclasses import dataclass, replace

import pytest
import torch
from several_processes import apart, camera, crowd, drawn, drawn_together, evened, in_processes, shrunk, trained

from surfkit.core.check import BadInput
from surfkit.densify import ADC, LossGradient, MatchedADC, Trim
from surfkit.densify.filters import CountCap, Elongation
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.regularizers import MeanOpacity
from surfkit.losses.surface import NormalConsistency
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.reference import Reference
from surfkit.train import checkpoint
from surfkit.train.adam import AdamInView
from surfkit.train.adam_batch import AdamBatch
from surfkit.train.divide import refuse_undivided
from surfkit.train.stage import Stage

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.parametrize("kind, geometry", [("surfel", "axis"), ("gaussian", "axis"), ("gaussian", "solid")])
def test_two_processes_draw_the_picture_of_one_and_get_its_gradients(kind, geometry):
    splats = crowd(kind, geometry)
    # the lower half is fuller, so that the strips move
    splats = replace(splats, means=splats.means + torch.tensor([0, 0.2, 0]))
    one, (two, other) = drawn(NativeRasterizer(), splats), in_processes(drawn_together, splats)
    assert two[1] == [(0, 4), (4, 7)] or two[1] == [(0, 3), (3, 7)]
    assert two[2] == other[2] and two[2] != two[1] and two[2][-1][1] == 7
    for name, value in one.items():
        both = two[0][name] if name.startswith("map") else torch.cat([two[0][name], other[0][name]])
        if name.startswith("by"):
            assert (both - value).norm() <= 1e-6 * value.norm() and value.norm() > 0, name
        else:
            assert torch.equal(both, value), name
        assert not name.startswith("map") or torch.equal(other[0][name], value)


def test_a_photograph_of_another_size_at_the_same_place_is_drawn_whole():
    splats = crowd("surfel")
    wanted = NativeRasterizer().render(splats, camera().resized(22, 25), 0.1).maps.color
    for found in in_processes(shrunk, splats):
        assert torch.equal(found, wanted)


def test_moments_of_16_bits_move_on_with_their_points():
    for rank, (params, first, second) in enumerate(in_processes(evened, 8)):
        assert params["opacities"].tolist() == [4.0 * rank + i for i in range(4)]
        for name, value in params.items():
            assert first[name].dtype == torch.bfloat16
            assert torch.equal(first[name].float(), value) and torch.equal(second[name].float(), value), name


@pytest.mark.parametrize("at, skipped, fits", [((3, 3), ([1], [1]), True), ((3, 4), ([], []), False)])
def test_processes_that_are_at_different_views_end(at, skipped, fits):
    for found in in_processes(apart, at, skipped):
        assert found == "" if fits else "by some of the processes and not by others" in found


# All that looks at more than one point: the ratio of the mean gradients, the quantile of a trim, the largest of a cap.
WHOLE = Stage(
    steps=20,
    losses={"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency()},
    signal=LossGradient(terms=("ssim",), boost=0.9),
    densify=ADC(
        threshold=1e-5, small=0.075, start=2, every=6, until=18, cull_opacity=0.08, filters=(Elongation(), CountCap(70))
    ),
    prune=(Trim(ratio=0.1, start=7, every=7, whole_epochs=False, recovery=0),),
    sh_every=8,
)


def matched(two, one) -> float:
    """The largest distance of a point of two from the nearest of one by all parameters, a share of the typical size."""
    both, each = (torch.cat([v.reshape(len(p), -1) for _, v in sorted(p.params.items())], 1) for p in (two, one))
    return float(torch.cdist(both.double(), each.double()).amin(1).max() / each.norm(dim=1).median())


def test_two_processes_train_as_one_does_and_their_checkpoint_is_that_of_one(begin, tmp_path):
    """Sums of float32 in another order are all that differs; the draws for children are the same, and all edits."""
    trainer, state = begin(WHOLE)
    first, half, last = (tmp_path / name / "checkpoint.safetensors" for name in ("first", "half", "last"))
    checkpoint.save(first, state)
    alone = [(done.losses, done.points) for done in trainer.run(state)]
    counts = {points for _, points in alone}
    assert len(counts) > 2 and max(counts) == 70, "there are edits, up to the cap"

    (two, mine), (other, theirs) = in_processes(trained, trainer, first, 20, last)
    assert two == other and [points for _, points in two] == [points for _, points in alone]
    for (here, _), (there, _) in zip(two, alone, strict=True):
        assert here == pytest.approx(there, rel=1e-4)
    assert mine + theirs == len(state.points) and max(mine, theirs) <= 0.55 * (mine + theirs) + 1
    found = checkpoint.load(last)
    assert found.index == 20 and len(found.points) == len(state.points)
    assert torch.equal(found.generator.get_state(), state.generator.get_state())
    assert matched(found.points, state.points) < 1e-3 and matched(state.points, found.points) < 1e-3

    in_processes(trained, trainer, first, 10, half)  # then one goes on from two
    begun = checkpoint.load(half)
    rest = [(done.losses, done.points) for done in trainer.run(begun)]
    assert [points for _, points in rest] == [points for _, points in alone[10:]]
    assert rest[-1][0] == pytest.approx(alone[-1][0], rel=1e-4)


def test_without_an_edit_the_parameters_stay_the_same_row_by_row(begin, tmp_path):
    trainer, state = begin(replace(WHOLE, densify=None, prune=()), Gaussian3D(1))
    first, last = (tmp_path / name / "checkpoint.safetensors" for name in ("first", "last"))
    checkpoint.save(first, state)
    in_processes(trained, trainer, first, 20, last)
    list(trainer.run(state))
    for name, value in checkpoint.load(last).points.params.items():
        apart = value - state.points.params[name]
        if name == "quats":  # round ones: their gradient is rounding alone, of which Adam makes whole steps
            assert apart.abs().max() <= 20 * 1e-3
        else:
            assert apart.norm() <= 1e-5 * state.points.params[name].norm(), name


def test_a_batch_moves_points_once_by_the_square_root_rule(begin):
    """Learning rates x sqrt(B), betas^B, epsilon / sqrt(B), against torch's Adam."""
    factor, beta1, beta2, epsilon = AdamBatch(views=4).scaled(4)
    assert (factor, beta1, beta2, epsilon) == pytest.approx((2, 0.9**4, 0.999**4, 1e-15 / 2), rel=1e-12)
    stage = Stage(steps=9, densify=None, optimizer=AdamBatch(views=4), sh_every=100)
    trainer, state = begin(stage)
    seen, before = [], state.points.params["means"].clone()
    given = torch.nn.Parameter(before.clone().double())
    adam = torch.optim.Adam([given], lr=1.0, betas=(beta1, beta2), eps=epsilon)
    held = []
    for done in trainer.run(state):
        gathered = state.points.stat("batch/means", 3).clone()
        held.append(torch.equal(state.points.params["means"], before) == (done.index % 4 != 0 and done.index < 9))
        before = state.points.params["means"].clone()
        if done.index % 4 == 3:
            seen.append(gathered)
    assert all(held), "points move after 4, 8 and, as the stage ends, 9 views"
    assert len(seen) == 2 and not torch.equal(*seen) and not state.points.stat("batch/means", 3).any()
    # two batches with known gradients
    points = begin(stage)[1].points
    given = torch.nn.Parameter(points.params["means"].clone().double())
    adam = torch.optim.Adam([given], lr=0.01 * factor, betas=(beta1, beta2), eps=epsilon)
    grads = torch.randn(8, *given.shape, generator=torch.Generator().manual_seed(1))
    for at, grad in enumerate(grads, 1):
        stage.optimizer.step(points, {"means": grad}, Given(at, 8, {"means": 0.01}))
        if at % 4 == 0:
            given.grad = grads[at - 4 : at].double().mean(0)
            adam.step()
    assert torch.allclose(points.params["means"].double(), given.detach(), atol=1e-6)


@dataclass(frozen=True)
class Given:
    """What `AdamBatch` reads of an `OptimizerInput`."""

    index: int
    steps: int
    rates: dict[str, float]


class Ours(ADC):
    """A part of somebody else, derived from one that works divided; it may do what it likes."""


@pytest.mark.parametrize(
    "change, text",
    [
        ({"optimizer": AdamInView()}, "pretrain.optimizer adam-in-view does not work"),
        ({"densify": MatchedADC()}, "pretrain.densify matched-adc does not work"),
        ({"densify": Ours()}, "pretrain.densify ours does not"),
        ({"regularizers": {"dim": MeanOpacity()}}, "pretrain.regularizers.dim looks at all points"),
        ({"primitive": Surfel2D(smoothing=0.2)}, "primitive.smoothing"),
        ({"rasterizer": Reference()}, "--device cpu"),
    ],
)
def test_what_does_not_say_that_it_divides_is_refused(change, text):
    primitive = change.pop("primitive", Surfel2D())
    rasterizer = change.pop("rasterizer", NativeRasterizer())
    refuse_undivided("pretrain", WHOLE, Surfel2D(), NativeRasterizer())
    with pytest.raises(BadInput, match="--processes") as refused:
        refuse_undivided("pretrain", replace(WHOLE, **change), primitive, rasterizer)
    assert text in str(refused.value)
