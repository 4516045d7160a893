"""LPIPS of the runs of an ablation table."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.evaluate.images.lpips import MIN_SIDE_PX, Net, NoWeights, load_perceptual
from surfkit.evaluate.images.measure_images import lpips_names, lpips_values
from surfkit.io.datasets.masks import mask_cache
from surfkit.raster.select import Device
from surfkit.runs.folder import note_metrics
from surfkit.runs.measure_run import note_compressed
from surfkit.runs.pipeline import loaded, opened
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import View

NET: Net = "alex"
"""The network of CityGaussianV2's released code; it is a tenth of the work of the other."""


def refuse_unmeasurable(views: Sequence[View]) -> None:
    """BadInput if LPIPS cannot be measured on some photographs."""
    if min(min(view.camera.width, view.camera.height) for view in views) < MIN_SIDE_PX:
        raise BadInput(f"--columns lpips: a photograph has a side of less than {MIN_SIDE_PX} pixels; leave lpips out")
    try:
        load_perceptual(NET)
    except NoWeights as error:
        raise BadInput(f"--columns lpips: {error}".replace("give --lpips-weights FOLDER", "leave lpips out")) from error


def measure_lpips(folder: Path, device: Device) -> dict[str, Any]:
    """Measure the LPIPS of a finished run on its held-out photographs, and return its metrics with it.

    Where the recipe compresses the model, it is that of the compressed model.

    Raises:
        BadInput: There is no run, or nothing to measure with.
    """
    run, network = opened(folder), load_perceptual(NET)
    compressed = run.recipe.compress is not None
    with loaded(folder, device, compressed) as (ctx, made):
        if made.draw is None:
            return read_json(run.metrics, dict[str, Any])
        metrics, found = read_json(ctx.run.metrics, dict[str, Any]), {}
        images, each = metrics["images"], metrics["images"].get("per_image", {})
        views = [view for view in ctx.scene.held_out if view.name in each]  # others could not be read
        masks = mask_cache(views, 0)
        draw = made.photographed(made.draw_color or made.draw)
        for at, view in enumerate(views):
            mask = None if masks is None else masks[at]
            if mask is None or mask.any():
                color = draw(view).need("color").clamp(0, 1)
                mask = None if mask is None else mask.to(color.device)
                found[view.name] = lpips_values([network], color, view_photo(view).to(color) / 255, mask)
        images |= {name: statistics.fmean(one[name] for one in found.values()) for name in lpips_names([network])}
        images["per_image"] = {name: values | found.get(name, {}) for name, values in each.items()}
        metrics = note_metrics(ctx.run.metrics, {"images": images})
    return note_compressed(run, metrics) if compressed else metrics
