"""Which axes a file of splats has that does not say so: those in which its splats look like the photographs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.splats.file_axes import Axes, AxesOrAuto, in_words
from surfkit.io.splats.models import in_scene, read_sound
from surfkit.io.splats.splat_files import assumed_axes, from_axes, untold_axes
from surfkit.io.splats.splat_table import SplatTable
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel, primitive_of
from surfkit.raster.psnr import psnr
from surfkit.raster.select import select
from surfkit.scene.photos import view_photo
from surfkit.scene.scene import Scene, View

TRIED_AXES: tuple[Axes, ...] = ("rdf", "rub", "luf", "ldb", "rfu", "rbd")
"""Axes that are compared: those of a PLY file, half a turn from them about each axis, and quarters about x."""
COMPARED_VIEWS = 4
"""Training photographs that are compared, evenly spaced."""
TRIAL_LONGEST_PX = 160
"""Longest side of these."""
CLEAR_DB = 1.0
"""PSNR by which the best axes must be ahead of all others."""
COMPARED_POINTS = 2_000
"""Sparse points whose distance to the nearest splat is compared where the photographs do not tell."""
MAX_COMPARED_SPLATS = 200_000
"""Splats that these are compared with at most."""
CLEAR_SHARE = 0.5
"""Of the median distance for all other axes, what that for the best must stay below."""


def read_in_scene(path: Path, scene: Scene, axes: AxesOrAuto, flag: str = "--axes") -> SplatTable:
    """The splats of a file in the local frame, all float32.

    Args:
        path: Of the file.
        scene: The data set that its coordinates are of.
        axes: Of the numbers in the file. For auto, those that the file names or its format has, or else the photographs
            and sparse points of the scene decide, which a note says.
        flag: That sets `axes`.

    Raises:
        BadInput: No file of splats, or one without splats, or with values that cannot be drawn.
    """
    table = read_sound(path)
    if axes != "auto":
        return in_scene(from_axes(table, axes), scene.frame)
    if table.axes.is_told:
        return in_scene(table, scene.frame)
    best, why = _best(table, scene)
    told = f"{best} ({in_words(best)}) {why}" if best else f"{assumed_axes(table)}, as {why}"
    emit(Warned(f"{untold_axes(path)}: {told}; {flag} NAME says otherwise"))
    return in_scene(from_axes(table, best or table.axes.name), scene.frame)


def _best(table: SplatTable, scene: Scene) -> tuple[Axes | None, str]:
    """The axes in which the splats of a file fit the scene clearly better than in all others, None where none do, and
    why."""
    decibels = _decibels(table, scene)
    best, second = sorted(decibels, key=decibels.__getitem__, reverse=True)[:2]
    if decibels[best] - decibels[second] >= CLEAR_DB:
        return best, f"fits the photographs best, PSNR {decibels[best]:.1f} dB, {decibels[second]:.1f} for {second}"
    away = _distances(table, scene)
    best, second = sorted(away, key=away.__getitem__)[:2]
    if away[best] < CLEAR_SHARE * away[second]:
        return best, "fits the sparse points of the data set best"
    return None, "neither photographs nor sparse points tell"


def _decibels(table: SplatTable, scene: Scene) -> dict[Axes, float]:
    """Mean PSNR of some photographs at a small size, for each axes; 0 where none can be read. Spherical harmonics above
    degree 0 are left out: to turn them takes more memory than all else."""
    plain = replace(table, sh_rest=table.sh_rest[:, :0])
    photos = [photo for view in scene.train[:: math.ceil(len(scene.train) / COMPARED_VIEWS)] if (photo := _small(view))]
    rasterizer, _ = select("cpu")
    found = {}
    for name in dict.fromkeys((table.axes.name, *TRIED_AXES)):
        local, primitive = in_scene(from_axes(plain, name), scene.frame), primitive_of(plain)
        model = SplatModel(primitive, primitive.from_table(local, torch.Generator()))
        draws, total = drawn_by(primitive, rasterizer), 0.0
        for view, target in photos:
            maps = draws.render(model.splats, view.camera, model.near, geometry=False, distortion=False).maps
            total += psnr(maps.need("color"), target)
        found[name] = total / max(len(photos), 1)
    return found


def _small(view: View) -> tuple[View, torch.Tensor] | None:
    """A view at LONGEST_PX and its (3, H, W) photograph in [0, 1]; None if that cannot be read."""
    small = replace(view, camera=view.camera.fitted(TRIAL_LONGEST_PX))
    try:
        return small, view_photo(small).float() / 255
    except BadInput:  # the run itself says so
        return None


def _distances(table: SplatTable, scene: Scene) -> dict[Axes, float]:
    """For each axes, the median distance of sparse points to the nearest splat; infinite without points."""
    points, found = scene.cloud.xyz.numpy(), {}
    points = points[:: math.ceil(max(len(points), 1) / COMPARED_POINTS)]
    few = table.take(slice(None, None, math.ceil(len(table) / MAX_COMPARED_SPLATS)))
    for name in dict.fromkeys((table.axes.name, *TRIED_AXES)):
        means = in_scene(from_axes(few, name), scene.frame).means.numpy()
        found[name] = float(np.median(cKDTree(means).query(points)[0])) if len(points) else math.inf
    return found
