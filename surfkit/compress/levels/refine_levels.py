"""A level of detail learns from what the full model draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import safetensors.torch as safetensors
import torch
from safetensors import SafetensorError
from torch import Tensor
from torch.nn.functional import interpolate

from surfkit.compress.levels.base import LodInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.files import replacing
from surfkit.core.schedule import LearningRate
from surfkit.densify.trim import summed
from surfkit.primitives.columns import RATES
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns, Points
from surfkit.scene.cache import Cache
from surfkit.scene.scene import View
from surfkit.train.faults import Diverged
from surfkit.train.next_view import foretell
from surfkit.train.stage import Stage
from surfkit.train.trainer import Trainer
from surfkit.train.view_order import ViewContributions

MIN_PICTURE_SIDE_PX = 32
"""Shorter side of the pictures that a level is refined on, at least, where the photographs have as much."""
FINAL_RATE_SHARE = 0.1
"""Learning rates fall to this share of themselves."""


def contributions(given: LodInput) -> Tensor:
    """(N,) float64 above 0: the blended weight of each point of the model, summed over the pixels of all views.

    Points that no view shows count as a thousandth of the mean.
    """
    model = given.model
    tally = ViewContributions(given.views, drawn_by(model.primitive, given.rasterizer), model.splats, model.near)
    found = summed(tally).double().cpu()
    return found.clamp_min(float(found.mean()) * 1e-3 or 1.0)


def refined(given: LodInput, level: SplatModel, number: int, steps: int, smaller: float) -> SplatModel:
    """A level after so many optimisation steps against renders of the full model, or as it was kept.

    Args:
        given: With the full model. What a call that was interrupted later has kept in its folder is not made again.
        level: To begin with.
        number: Of the level.
        steps: 0 leaves it as it is.
        smaller: Above 1, each view is also shown so many times smaller, as it is seen from so much farther away. (On a
            model of 32,000 surfels, a level of an eighth of them came so to 31.6 instead of 29.5 dB against the full
            model at half the size, and to 29.2 instead of 31.1 dB at the whole.)
    """
    if steps == 0:
        return level
    path = given.folder / f"level{number}.safetensors"
    if (kept := _kept(path, level.params)) is not None:
        return replace(level, params=kept)
    views = tuple(given.views)
    if smaller > 1:
        views += tuple(seen_from_afar(view, smaller) for view in given.views)
    pictures = renders(given, views)
    try:
        params = _optimised(given, level, views, pictures, number, steps)
    except Diverged as error:
        emit(Warned(f"level {number} of detail is not refined: {error}"))
        return level
    finally:
        pictures.close()
    with replacing(path) as file:
        file.write(safetensors.save({name: value.contiguous() for name, value in params.items()}))
    return replace(level, params=params)


def seen_from_afar(view: View, smaller: float) -> View:
    """A view with a picture that is so many times smaller, but not smaller than SMALLEST_PX."""
    camera = view.camera
    shorter = min(camera.width, camera.height)
    by = min(smaller, max(1.0, shorter / MIN_PICTURE_SIDE_PX))
    return replace(view, camera=camera.resized(max(1, round(camera.width / by)), max(1, round(camera.height / by))))


def renders(given: LodInput, views: Sequence[View]) -> Cache[Tensor]:
    """(3, H, W) uint8 of the training views in turn, some of them smaller: what the full model draws at their own size,
    averaged over the pixels."""
    model = given.model
    draws, splats = drawn_by(model.primitive, given.rasterizer), model.splats.detached()

    def picture(at: int) -> Tensor:
        camera = given.views[at % len(given.views)].camera
        drawn = draws.render(splats, camera, model.near, False, False).maps.need("color").clamp(0, 1)
        size = (views[at].camera.height, views[at].camera.width)
        small = drawn if drawn.shape[1:] == size else interpolate(drawn[None], size, mode="area")[0]
        return (small * 255).round().to("cpu", dtype=torch.uint8)

    sizes = [3 * view.camera.width * view.camera.height for view in views]
    return Cache(picture, sizes, given.budget_bytes, threads=1)


def _optimised(
    given: LodInput, level: SplatModel, views: Sequence[View], pictures: Cache[Tensor], number: int, steps: int
) -> Columns:
    """Raw parameters after the steps, on the CPU."""
    primitive = level.primitive
    starts = {name: column.rate.start for name, column in primitive.columns().items()}
    rates = {
        name: LearningRate(rate, FINAL_RATE_SHARE * rate) if rate else LearningRate(0.0)
        for name, rate in starts.items()
    }
    rates |= {"means": RATES["means"]} if "means" in rates else {}
    stage = Stage(steps=steps, densify=None, rates=rates, near=level.near)
    trainer = Trainer(stage, primitive, views, pictures, given.rasterizer, expect=pictures.expect)
    points = Points.fresh({name: value.clone() for name, value in level.params.items()}, primitive.shared())
    state = trainer.begin(points, torch.Generator().manual_seed(given.seed + number))
    state.sh_degree = level.sh_degree
    foretell(trainer, state.order)
    while state.index < steps:
        trainer.step(state)
        emit(Progress(f"refining level {number} of detail", state.index, steps))
    return {name: value.detach().cpu() for name, value in state.points.all_params().items()}


def _kept(path: Path, like: Columns) -> Columns | None:
    """The parameters that a file keeps, if it is whole and has columns of these names and shapes."""
    try:
        found = safetensors.load_file(path)
    except (OSError, SafetensorError):
        return None
    fits = {n: v.shape for n, v in found.items()} == {n: v.shape for n, v in like.items()}
    return found if fits else None
