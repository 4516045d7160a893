"""The time that depth maps take before the first step, by those of a few photographs that show the same place."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from surfkit.apps.doctor.examine import ExaminedData
from surfkit.apps.doctor.gather import depth_maps, heard
from surfkit.core.check import BadInput
from surfkit.depth.base import DepthInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.panoramas import view_names
from surfkit.io.datasets.read import build_scene, observations
from surfkit.raster.select import Device, torch_device
from surfkit.runs.recipe import Recipe
from surfkit.train.data_cache import needs_priors

MEASURED_VIEWS = 12
"""Photographs that maps are made of: they follow one another, and so show the same places."""
MEASURED_PX = 320
"""Longest side at which they are compared: the time is that of the pixels."""


def depth_seconds(
    data: Data, examined: ExaminedData, recipe: Recipe, sizes: list[tuple[int, int]], device: Device, folder: Path
) -> float:
    """Seconds that the depth maps of a run take; 0 where it makes none, or a few photographs do not tell.

    Args:
        data: A data set without errors.
        examined: What is known of it.
        recipe: What to do with it.
        sizes: Widths and heights at which its views are used.
        device: Where to compute.
        folder: For what is to be deleted.
    """
    train, estimator = examined.gathered.train, recipe.depth
    wanted = recipe.start.needs_prior or recipe.method.needs_prior or needs_priors(recipe.pretrain.losses)
    if estimator is None or not wanted or not train or depth_maps(data, examined.gathered):
        return 0.0
    first = max(0, (len(train) - MEASURED_VIEWS) // 2)
    with heard():
        some = set(view_names(train[first : first + MEASURED_VIEWS]))
        scene = build_scene(data, examined.gathered.capture, folder, some)
        tracks = observations(data, scene)
        views = tuple(replace(view, camera=view.camera.fitted(MEASURED_PX)) for view in scene.train)
        work = folder / "depth-maps"
        work.mkdir()
        begun = time.perf_counter()
        try:
            made = list(estimator.estimate(DepthInput(views, tracks, torch_device(device), work), range(len(views))))
        except BadInput:  # told by what looks at the depth maps
            return 0.0
    seconds = time.perf_counter() - begun
    done = [views[one.at].camera for one in made if one.inverse is not None]
    # Maps of larger photographs have no more pixels than this.
    largest = getattr(estimator, "longest", float("inf")) * getattr(estimator, "scale", 1)
    pixels = sum(w * h * min(1.0, largest / max(w, h)) ** 2 for w, h in sizes)
    return seconds * pixels / sum(camera.width * camera.height for camera in done) if done else 0.0
