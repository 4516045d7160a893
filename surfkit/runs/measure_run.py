"""What a run has come to, measured on the held-out photographs."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

from torch import Tensor

from surfkit.core.codec import read_json, write_json
from surfkit.core.events import FileWritten, emit
from surfkit.evaluate.images.comparison_pictures import panel, picture_path, write_picture
from surfkit.evaluate.images.lpips import networks
from surfkit.evaluate.images.measure_images import Draw, evaluate_views, frames_per_second
from surfkit.io.datasets.masks import mask_cache
from surfkit.raster.api import Maps
from surfkit.runs.compress_model import decompressed
from surfkit.runs.context import RunContext
from surfkit.runs.folder import Run, RunStage, note_metrics, read_record
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.run_method import not_drawn
from surfkit.scene.photos import photo_cache
from surfkit.scene.scene import Scene, View
from surfkit.train.memory_meter import MemoryMeter

PHOTOS_AHEAD = 8
"""Photographs in memory while held-out ones are measured: each is needed once."""


def evaluate(
    run: Run,
    made: Reconstruction,
    scene: Scene,
    meter: MemoryMeter | None = None,
    lpips_weights: str = "auto",
) -> dict[str, Any]:
    """Measure on the held-out photographs, write pictures and metrics, and return all the metrics there are.

    Where nothing draws them, there is no PSNR, and the metrics say why.

    Args:
        run: The run.
        made: What it has come to.
        scene: Its data.
        meter: Of a run that is being made; without one, what memory was taken by stays as it was measured then.
        lpips_weights: See `surfkit.evaluate.images.lpips.networks`.
    """
    sides = [min(view.camera.width // 2, view.camera.height) for view in scene.held_out]  # halves are measured too
    perceptual, lacking = networks(lpips_weights, min(sides)) if sides and made.draw else ((), None)
    colors = made.draw_color or made.draw
    ahead = PHOTOS_AHEAD * max((3 * view.camera.width * view.camera.height for view in scene.held_out), default=0)

    def show(view: View, photo: Tensor, maps: Maps) -> None:
        write_picture(picture_path(run.pictures, view.name), panel(photo, maps))

    with meter.adding("pictures") if meter else nullcontext():
        if made.draw is None:
            measured = not_drawn(run)
        else:
            measured = evaluate_views(
                scene.held_out,
                photo_cache(scene.held_out, ahead),
                made.photographed(made.draw_there or made.draw),
                timed=colors,
                show=show,
                masks=mask_cache(scene.held_out, ahead),
                networks=perceptual,
            )
    if lacking is not None:
        measured["images"]["lpips_not_measured"] = lacking
    if meter:
        meter.tell()
    record = read_record(run.out)
    memory, on_gpu = record.get("memory_bytes") or {}, record.get("gpu_memory_bytes") or {}
    if (made.peak_gpu_bytes or 0) > on_gpu.get("peak", 0):
        on_gpu = {"peak": made.peak_gpu_bytes}  # of a process of its own
    metrics = {
        **measured,
        "fps": measured["fps"] or (frames_per_second(scene.train, colors) if colors else None),
        "points": None if made.splats is None else len(made.splats),
        "bytes": run.cloud.stat().st_size if run.cloud.exists() else None,
        "steps": made.steps,
        "seconds": made.seconds,
        "cpu_seconds": made.cpu_seconds,
        "prepare_cpu_seconds": record.get("prepare_cpu_seconds"),
        "peak_memory_bytes": max(made.peak_memory_bytes or 0, memory.get("peak", 0)) or None,
        "memory_bytes": memory,
        **({"peak_gpu_bytes": on_gpu["peak"], "gpu_memory_bytes": on_gpu} if on_gpu else {}),
        **({"method": dict(made.facts)} if made.facts else {}),
        **({"before": before} if (before := measured_before(run)) else {}),
    }
    return note_metrics(run.metrics, metrics)


def measure_before(stage: RunStage, made: Reconstruction, scene: Scene) -> None:
    """Measure the model that a refinement begins with on the held-out photographs, and write it into its folder.

    Args:
        stage: The refinement.
        made: The model, with a way to draw it.
        scene: Held-out views.
    """
    if not scene.held_out:
        return
    assert made.splats is not None, "a refinement begins with splats"
    ahead = PHOTOS_AHEAD * max(3 * view.camera.width * view.camera.height for view in scene.held_out)
    found = evaluate_views(
        scene.held_out,
        photo_cache(scene.held_out, ahead),
        made.photographed(drawing_colors(made)),
        masks=mask_cache(scene.held_out, ahead),
    )["images"]
    write_json(
        stage.before,
        {name: value for name, value in found.items() if name != "per_image"} | {"points": len(made.splats)},
    )
    emit(FileWritten(stage.before, "measurements before the refinement"))


def drawing_colors(made: Reconstruction) -> Draw:
    """What draws the colours of a reconstruction that is drawn, without more than it must."""
    draw = made.draw_color or made.draw
    assert draw is not None, "splats are drawn"
    return draw


def measured_before(run: Run) -> dict[str, Any]:
    """What was measured of the model before each refinement, by the name of its stage."""
    stages = run.stages if run.recipe.has_stages else ()
    return {stage.name: read_json(stage.before, dict[str, Any]) for stage in stages if stage.before.exists()}


def measure_compressed(ctx: RunContext, made: Reconstruction, lpips_weights: str = "gpu") -> dict[str, Any]:
    """Measure the compressed model of a run as the run itself, and return all the metrics of the run.

    They lie in its folder; those of the run say in short what became of size, quality and speed.
    """
    run, (inner, small) = ctx.run, decompressed(ctx, made)
    found = evaluate(inner.run, small, ctx.scene, lpips_weights=lpips_weights)
    views = ctx.scene.held_out or ctx.scene.train
    both = [frames_per_second(views, drawing_colors(each)) for each in (made, small)]
    note_metrics(inner.run.metrics, {"fps_before_and_after": both})  # within a minute, on the same machine
    return note_compressed(run, found | {"fps_before_and_after": both})


def note_compressed(run: Run, found: dict[str, Any]) -> dict[str, Any]:
    """Say in the metrics of a run in short what those of its compressed model say, and return them; {} without any."""
    if not run.metrics.exists():
        return {}  # the run has yet to be measured itself
    record = read_json(run.compressed_record, dict[str, Any])
    facts = {name: record[name] for name in ("compressor", "bytes", "ply_bytes")}
    facts["images"] = {name: value for name, value in found.get("images", {}).items() if isinstance(value, float)}
    facts["fps_before_and_after"] = found.get("fps_before_and_after")
    if "geometry" in found:
        kept = ("precision", "recall", "f1", "truth", "tau", "table", "chamfer_dtu", "normals", "roughness")
        facts["geometry"] = {name: value for name, value in found["geometry"].items() if name in kept}
    if "mesh" in found:
        facts["mesh"] = found["mesh"]
    return note_metrics(run.metrics, {"compressed": facts})
