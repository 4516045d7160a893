"""Training on a GPU that is simulated: everything of a step is there, with few waits, and comes to the same."""

import gc
import shutil
from dataclasses import replace
from functools import cache

import pytest
import torch

from surfkit.appearance.base import Appearance
from surfkit.core.registry import components
from surfkit.densify.adc import ADC
from surfkit.densify.base import Densify, Filter, Prune, Signal
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.losses.base import Loss, Regularizer
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.surface import Distortion, NormalConsistency
from surfkit.losses.transients import Transients
from surfkit.primitives.base import Primitive
from surfkit.raster.cuda.gpu import CudaRasterizer
from surfkit.raster.cuda.rasterizer import TileRasterizer, source
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.testing.simulated_gpu import GPU, OnSimulatedGpu, is_there, simulated_gpu
from surfkit.train import checkpoint
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.optimizer import Optimizer
from surfkit.train.stage import Stage

pytestmark = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "c++", "clang++")), reason="the emulator needs a C++ compiler"
)
EDITS = ADC(start=2, until=18, every=5, threshold=1e-5)
"""Densifies what the tiny scene has, every few steps."""


@cache
def emulated(name: str, **defines: int) -> Emulated:
    return Emulated(source(name, **defines), device=GPU)


class EmulatedGpu(TileRasterizer):
    """The CUDA kernels, emulated."""

    def where(self) -> torch.device:
        return GPU

    def program(self, name: str, **defines: int) -> Emulated:
        return emulated(name, **defines)


def everything(tiny):
    """Priors and masks for all views."""
    one = torch.ones(22, 28)
    normal = torch.stack([0 * one, 0 * one, -one])
    priors = [DepthPrior(one, one, 1.0, normal) for _ in tiny.views]
    return priors, [torch.arange(28).expand(22, 28) > 3 for _ in tiny.views]


def trained(begin, stage, rasterizer, tiny, primitive=None):
    """The trainer and its state after all steps; where there are second views, also of a surface."""
    trainer, _ = begin(stage, primitive)
    priors, masks = everything(tiny)
    trainer = replace(trainer, rasterizer=rasterizer, priors=priors, masks=masks)
    _, state = begin(stage, primitive)
    if any(loss.needs_neighbour for loss in stage.losses.values()):
        trainer = replace(trainer, beside=lambda at, depth: [(at + 1) % len(tiny.views)])
        state.points.params["opacities"] += 4.0
        state.points.params["scales"] += 0.5
    for done in trainer.run(state):
        paired = stage.is_paired(done.index)
        assert not paired or all(value > 0 for value in done.losses.values()), "a second view shows nothing of use"
    return trainer, state


def places(state):
    points = state.points
    groups = (points.params, points.exp_avg, points.exp_avg_sq, points.stats, points.shared)
    return [is_there(value) for group in groups for value in group.values()]


@pytest.mark.parametrize("optimizer", [Adam(), AdamInView()], ids=["all", "in-view"])
def test_same_points_as_on_the_cpu_with_few_waits(tiny, begin, tmp_path, optimizer):
    losses = {"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency(), "distortion": Distortion(weight=1.0, start=0)}
    stage = Stage(steps=20, losses=losses, densify=EDITS, optimizer=optimizer)
    _, here = trained(begin, stage, tiny.rasterizer, tiny)
    with simulated_gpu() as gpu:
        _, there = trained(begin, stage, OnSimulatedGpu(tiny.rasterizer), tiny)
        assert all(places(there)), "something of the points is not on the GPU"
        checkpoint.save(tmp_path / "state.safetensors", there)
        there.move(torch.device("cpu"))
        assert not any(places(there))
    assert len(here.points) == len(there.points) > 40, "nothing was densified"
    for name, value in here.points.all_params().items():
        torch.testing.assert_close(there.points.all_params()[name], value, rtol=1e-3, atol=1e-4)
    loaded = checkpoint.load(tmp_path / "state.safetensors")
    assert torch.equal(loaded.points.params["means"], there.points.params["means"])
    waits = {name: count for name, count in gpu.waits.items() if name != "to cpu"}  # those are the rasterizer's
    assert waits.pop("tolist") == 2 * 20, "a step waits once for its losses and once for whether all is finite"
    in_view = 2 * 20 if optimizer.in_view else 0
    assert waits.get("nonzero", 0) >= in_view, "a step waits for how many points are in blocks in view, and in view"
    assert sum(waits.values()) < 60 + in_view, "edits wait for the numbers of their points, steps do not"


@pytest.mark.parametrize("optimizer", [Adam(), AdamInView()], ids=["all", "in-view"])
def test_with_the_kernels(tiny, begin, optimizer):
    losses = {"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency(), "distortion": Distortion(weight=1.0, start=0)}
    stage = Stage(steps=4, losses=losses, densify=replace(EDITS, start=1, every=2), optimizer=optimizer)
    _, here = trained(begin, stage, tiny.rasterizer, tiny)
    with simulated_gpu():
        _, there = trained(begin, stage, EmulatedGpu(), tiny)
        there.move(torch.device("cpu"))
    assert len(here.points) == len(there.points) > 40
    for name, value in here.points.all_params().items():
        torch.testing.assert_close(there.points.all_params()[name], value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("optimizer", [Adam(), AdamInView()], ids=["all", "in-view"])
def test_a_step_leaves_nothing_on_the_gpu(tiny, begin, optimizer):
    """Also where Python collects no cycles of references: it does so by the number of objects, not their bytes."""
    losses = {"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency(), "distortion": Distortion(weight=1.0, start=0)}
    trainer, _ = begin(Stage(steps=12, losses=losses, optimizer=optimizer))
    gc.collect()
    gc.disable()
    try:
        with simulated_gpu() as gpu:
            trainer = replace(trainer, rasterizer=EmulatedGpu())
            _, state = begin(trainer.stage)
            held = [gpu.held for _ in trainer.run(state)]
    finally:
        gc.enable()
    held = held[-6:-1]  # all photographs are there by then; before the last step none is awaited
    assert held[0] > 0 and len(set(held)) == 1


PARTS = [
    (kind, name)
    for kind in (Loss, Regularizer, Densify, Filter, Prune, Signal, Appearance, Transients, Optimizer, Primitive)
    for name, cls in components(kind).items()
    if cls.__module__.startswith("surfkit.")
]


def soon(part):
    """The part with numbers that make it act in a few steps, also within what it wraps."""
    known = {"start": 1, "every": 2, "until": 6, "at": (2, 4), "threshold": 1e-5}
    wanted = {name: value for name, value in known.items() if hasattr(part, name)}
    if isinstance(part, Loss):
        wanted = {"start": 0, "every": 1} if part.needs_neighbour else {"start": 0} if part.weight_at(1, 6) == 0 else {}
        wanted |= {"weight": 1.0} if getattr(part, "weight", 1.0) == 0 else {}
    wrapped = {name: soon(value) for name, value in vars(part).items() if isinstance(value, Densify)}
    return replace(part, **wanted, **wrapped)


def staged(kind, name):
    """A few steps with a part that acts in them, and the primitive if it is the part."""
    part, stage, primitive = soon(components(kind)[name]()), Stage(steps=6, densify=None), None
    edits = soon(ADC())
    if kind is Loss:
        stage = replace(stage, losses={"l1": L1(), "it": part})
        assert stage.weights_at(2)["it"] > 0
    elif kind is Primitive:
        primitive, stage = part, replace(stage, densify=edits)
    else:
        changes = {
            Regularizer: {"regularizers": {"it": part}},
            Appearance: {"appearance": part},
            Transients: {"transients": part},
            Optimizer: {"optimizer": part},
            Signal: {"signal": part, "densify": edits},
            Filter: {"densify": replace(edits, filters=(part,))},
            Densify: {"densify": part},
            Prune: {"prune": (part,)},
        }
        stage = replace(stage, **changes[kind])
    return stage, primitive


@pytest.mark.parametrize(("kind", "name"), PARTS, ids=[f"{kind.__name__}-{name}" for kind, name in PARTS])
def test_every_part_runs_there(tiny, begin, kind, name):
    stage, primitive = staged(kind, name)
    with simulated_gpu():
        _, state = trained(begin, stage, OnSimulatedGpu(tiny.rasterizer), tiny, primitive)
        assert all(places(state)), f"{name}: not all is on the GPU"


@pytest.mark.cuda
@pytest.mark.skipif(CudaRasterizer().missing() is not None, reason=str(CudaRasterizer().missing()))
def test_on_a_gpu(tiny, begin):
    """A real one; twice the same bits."""
    losses = {"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency(), "distortion": Distortion(weight=1.0, start=0)}
    stage = Stage(steps=20, losses=losses, densify=EDITS)
    _, here = trained(begin, stage, tiny.rasterizer, tiny)
    there, again = (trained(begin, stage, CudaRasterizer(), tiny)[1] for _ in range(2))
    assert {value.device.type for value in there.points.all_params().values()} == {"cuda"}
    assert len(here.points) == len(there.points) > 40
    for name, value in here.points.all_params().items():
        found = there.points.all_params()[name]
        torch.testing.assert_close(found.cpu(), value, rtol=1e-3, atol=1e-4)
        assert torch.equal(found, again.points.all_params()[name])
