"""From a trained run to its compressed model: chosen, written into the run folder, and measured."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from surfkit.compress.base import Compressor, Plan
from surfkit.compress.container import ModelFile, write_model
from surfkit.core.check import BadInput, Fault, expect, expect_kind, read_only
from surfkit.core.codec import dump, read_json, read_keys, write_json
from surfkit.core.events import FileWritten, Progress, Warned, emit
from surfkit.core.registry import class_path, name_of
from surfkit.densify.trim import Trim
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel
from surfkit.raster.base import Rasterizer
from surfkit.raster.psnr import psnr
from surfkit.runs.context import RunContext
from surfkit.runs.folder import Run
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.run_method import splats_of, with_drawing
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Frame, View
from surfkit.train.view_order import ViewContributions

JUDGED_VIEWS = 24
"""Training views, evenly spaced, on which the loss is estimated while settings are chosen."""
MAX_TRIES = 8
"""Of settings, between the two ends below."""
MIN_ERROR_FACTOR, MAX_ERROR_FACTOR = 1 / 64, 32.0
"""Errors that are tried, as factors of those of the compressor."""


@dataclass(frozen=True)
class CompressionTarget:
    """What a compressed model shall come to: one of the two, or neither.

    Attributes:
        bytes: Of the file, at most.
        decibels: By which PSNR on training views may fall, at most.
    """

    bytes: int | None = None
    decibels: float | None = None

    @property
    def is_set(self) -> bool:
        """Whether settings are to be chosen."""
        return self.bytes is not None or self.decibels is not None


def make_wanted_compressed(ctx: RunContext, made: Reconstruction) -> None:
    """Compress as the recipe wants; that it cannot be done is told, and costs no measurements."""
    run = ctx.run
    assert run.recipe.compress is not None
    try:
        compress_run(ctx, made, run.recipe.compress)
    except BadInput as error:
        emit(Warned(f"no compressed model: {error}; `{run.to_paste('compress')}` tries again with other settings"))


def compress_run(
    ctx: RunContext, made: Reconstruction, compressor: Compressor, target: CompressionTarget | None = None
) -> dict[str, Any]:
    """Compress the model of a run into its folder, and return what compressed.json says.

    Raises:
        BadInput: The run has no splats, or they cannot be compressed so.
    """
    began, run, model = time.perf_counter(), ctx.run, on_cpu(splats_of(ctx.run, made))
    importance = importance_of(model, ctx.scene.train, ctx.rasterizer) if compressor.needs_importance else None
    run.compressed.mkdir(exist_ok=True)
    write = writing(model, importance, ctx.scene.frame, run.recipe.seed, ctx.rasterizer.where())
    if target is not None and target.is_set:
        judge = None if target.decibels is None else PsnrDrop(model, ctx.scene.train, ctx.rasterizer)
        compressor = fitted(compressor, target, write, judge)
    size = write(run.compressed_model, compressor)
    forget_compressed(run)  # only now: what cannot be compressed so costs nothing of before
    record = {
        "compressor": compressor,
        "steps": made.last_steps,
        "points": len(model),
        "bytes": size,
        "ply_bytes": run.cloud.stat().st_size if run.cloud.exists() else None,
        "seconds": round(time.perf_counter() - began, 2),
    }
    write_json(run.compressed_record, record)
    emit(FileWritten(run.compressed_model, "compressed model"))
    emit(FileWritten(run.compressed_record, "facts of the compressed model"))
    return dump(record)


def size_with(ctx: RunContext, made: Reconstruction, compressor: Compressor) -> int | None:
    """About how many bytes the model of a run would take with another compressor; None where that cannot take it.

    It is written into a temporary folder. Which points matter to the photographs is not looked at, as the size hardly
    depends on it.
    """
    model, seed = on_cpu(splats_of(ctx.run, made)), ctx.run.recipe.seed
    importance = torch.rand(len(model), generator=torch.Generator().manual_seed(seed))
    write = writing(model, importance, ctx.scene.frame, seed, ctx.rasterizer.where())
    with TemporaryDirectory() as folder:
        try:
            return write(Path(folder) / "other.surfkit", compressor)
        except BadInput:
            return None


def forget_compressed(run: Run) -> None:
    """Delete what says of an earlier file how it was made, and what was measured and made of it."""
    for path in (run.compressed_record, *(run.compressed / name for name in ("metrics.json", "mesh.json"))):
        path.unlink(missing_ok=True)
    if run.metrics.exists() and "compressed" in (metrics := read_json(run.metrics, dict[str, Any])):
        del metrics["compressed"]
        write_json(run.metrics, metrics)


def writing(
    model: SplatModel,
    importance: Tensor | None,
    frame: Frame | None,
    seed: int,
    device: torch.device = torch.device("cpu"),
) -> Callable[[Path, Compressor], int]:
    """What writes a model as `.surfkit` file with a compressor, tells its progress, and returns the bytes.

    `importance`: (N,) of the points, or None.
    """

    def write(path: Path, compressor: Compressor) -> int:
        name = f"{class_path(type(compressor))}.plan"
        with read_only(name, model.params, Fault):
            plan = compressor.plan(model, importance, seed, device)
        expect_kind(name, plan, Plan)
        for mark, value in plan.marks.items():
            expect(f"{name}: marks: {mark}", value, (len(model), *tuple(getattr(value, "shape", ()))[1:]))
        return write_model(
            path, model, plan, compressor, frame, lambda done, of: emit(Progress("compressing points", done, of))
        )

    return write


def has_compressed(run: Run, steps: int) -> bool:
    """Whether the file that a recipe wants is there, made from splats of so many steps; it may want none."""
    if run.recipe.compress is None:
        return True
    if not run.compressed_record.exists():
        return False
    remedy = f"delete it, and `{run.to_paste('compress')}` makes it again"
    return read_keys(run.compressed_record, {"steps": int}, remedy)["steps"] == steps and run.compressed_model.exists()


def decompressed(ctx: RunContext, made: Reconstruction) -> tuple[RunContext, Reconstruction]:
    """A run with the model of its compressed file in place of its own; results go to the folder of that file.

    Raises:
        BadInput: There is no such file, it is damaged, or of an earlier model.
    """
    run = ctx.run
    if not run.compressed_record.exists() or not run.compressed_model.exists():
        raise BadInput(f"{run.out}: there is no compressed model; `{run.to_paste('compress')}` makes one")
    model, _ = ModelFile(run.compressed_model).read()
    small = replace(made, splats=model, mesh=None, draw=None, draw_there=None, draw_color=None, draw_of=None)
    return replace(ctx, run=replace(run, out=run.compressed)), with_drawing(small, ctx.rasterizer)


def importance_of(model: SplatModel, views: Sequence[View], rasterizer: Rasterizer) -> Tensor:
    """(N,) mean contribution of each point over views, as `Trim` ranks points (CityGaussianV2, section 3.3)."""
    gamma, draws = Trim().gamma, drawn_by(model.primitive, rasterizer)
    with torch.no_grad():
        tally = ViewContributions(views, draws, model.splats.detached(), model.near)
        total = torch.zeros(len(model))
        for at, (amount, pixels) in enumerate(tally.each(gamma, 1 - gamma), 1):
            total += (amount / pixels.clamp_min(1)).cpu()
            emit(Progress("contributions to views", at, len(views)))
    return total / max(1, len(views))


def on_cpu(model: SplatModel) -> SplatModel:
    """The same model without autograd graph, on the CPU."""
    return replace(model, params={name: value.detach().cpu().contiguous() for name, value in model.params.items()})


class PsnrDrop:
    """Tells how much of the PSNR of a model on training views another one loses."""

    def __init__(self, model: SplatModel, views: Sequence[View], rasterizer: Rasterizer) -> None:
        step = max(1, -(-len(views) // JUDGED_VIEWS))
        self.views, self.draws, self.near = views[::step], drawn_by(model.primitive, rasterizer), model.near
        self.photos: list[Tensor] = []
        self.renders: list[Tensor] = []
        for view in self.views:
            self.photos.append(view_photo(view).float() / 255)
            self.renders.append(self._render(model, view))

    def loss(self, other: SplatModel) -> float:
        """Decibels: the larger of what is measured and what the difference of the renders leads one to expect.

        What is measured on few views may even be a gain, by chance; errors that are independent of those of the model
        add to them.
        """
        measured, expected = [], []
        for view, photo, before in zip(self.views, self.photos, self.renders, strict=True):
            after = self._render(other, view)
            own, change = psnr(before, photo), psnr(after, before)
            measured.append(own - psnr(after, photo))
            expected.append(10 * math.log10(1 + 10 ** ((own - change) / 10)))
        return max(sum(measured), sum(expected)) / len(measured)

    def _render(self, model: SplatModel, view: View) -> Tensor:
        with torch.no_grad():
            maps = self.draws.render(model.splats, view.camera, self.near, geometry=False, distortion=False).maps
        return maps.need("color").clamp(0, 1).cpu()


def fitted(
    compressor: Compressor,
    target: CompressionTarget,
    write: Callable[[Path, Compressor], int],
    judge: PsnrDrop | None = None,
) -> Compressor:
    """The compressor with errors as large as the target allows, or as small; bisected on the scale of all errors.

    Args:
        compressor: To be changed.
        target: One of its two is set.
        write: Writes a file with a compressor and returns its bytes.
        judge: For a loss.

    Raises:
        BadInput: The target cannot be reached, or the compressor has no such setting.
    """

    def fits(factor: float) -> bool:
        """Whether a file is good enough at this factor; files of fewer bytes lose more."""
        tried = compressor.coarser(factor)
        path = Path(folder) / "tried.surfkit"
        size = write(path, tried)
        done[0] += 1
        emit(Progress("choosing settings", done[0], MAX_TRIES + 2))
        if target.bytes is not None:
            return size <= target.bytes
        assert judge is not None and target.decibels is not None, "a target is one of the two"
        return judge.loss(ModelFile(path).read()[0]) <= target.decibels

    done = [0]
    with TemporaryDirectory() as folder:
        good, bad = (
            (MAX_ERROR_FACTOR, MIN_ERROR_FACTOR) if target.bytes is not None else (MIN_ERROR_FACTOR, MAX_ERROR_FACTOR)
        )
        if fits(bad):
            return compressor.coarser(bad)
        if not fits(good):
            what = f"{target.bytes:,} bytes" if target.bytes is not None else f"{target.decibels:g} dB"
            raise BadInput(f"compress:{name_of(compressor)} does not come to {what} with any setting; allow more")
        for _ in range(MAX_TRIES):
            middle = math.sqrt(good * bad)
            good, bad = (middle, bad) if fits(middle) else (good, middle)
    return compressor.coarser(good)
