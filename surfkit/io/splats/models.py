"""Splats of a file of any format, checked and moved into the local frame of a scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.splats.splat_files import format_of
from surfkit.io.splats.splat_table import SplatTable
from surfkit.scene.scene import Frame, Scene, View

MAX_SEARCHED_VIEWS = 64
"""Training views that are searched for splats, evenly spaced."""


def model_file(path: Path) -> Path:
    """The file that a path names: itself, or the points in the folder of a run."""
    return path / "point_cloud.ply" if path.is_dir() else path


def existing_model(path: Path | None, setting: str) -> Path:
    """The file that the value of a setting names.

    Raises:
        BadInput: It names none, or there is none.
    """
    if path is None:
        raise BadInput(f"{setting} is not set; name a file of splats with --{setting} FILE")
    found = model_file(path)
    if not found.is_file():
        what = "a folder without point_cloud.ply" if path.is_dir() else "no such file"
        raise BadInput(f"{setting} {path}: {what}; name a file of splats, or the folder of a finished run")
    return found


def read_sound(path: Path) -> SplatTable:
    """The splats of a file as it has them.

    Raises:
        BadInput: No file of splats, or one without splats, or with values that cannot be drawn.
    """
    table = format_of(path).read(path)
    if not len(table):
        raise BadInput(f"{path}: there are no splats in it; write it again, or name another file")
    refuse_unsound(path, table)
    return table


def in_scene(table: SplatTable, frame: Frame) -> SplatTable:
    """The splats of a file in the local frame of a data set, all float32.

    Files hold coordinates of the data set. Some formats have no place for the offset of survey coordinates: where the
    splats lie nearer to the scene with the offset of the data set than without, it is added.
    """
    table = replace(table, means=table.means.double() + _lacking_offset(table.means, frame))
    return table.in_local_frame(frame)


def refuse_unsound(path: Path, table: SplatTable) -> None:
    """BadInput for splats of a file that cannot be drawn."""
    table.refuse_unsound(path)
    scales = table.log_scales.exp()
    wrong = {
        "a rotation of length 0": ~(table.quats.norm(dim=1) > 0),
        "a scale of 0 or beyond float32": ~((scales > 0) & scales.isfinite()).all(1),
    }
    for what, rows in wrong.items():
        if count := int(rows.sum()):
            raise BadInput(
                f"{path}: {count:,} of {len(table):,} splats have {what}, splat {int(rows.nonzero()[0])} is the first; "
                "remove them in the program that made the file"
            )


def _lacking_offset(means: Tensor, frame: Frame) -> Tensor:
    """(3,) float64, what positions in a file lack to lie in the frame of the input: 0, or the shift of that frame."""
    shift, origin = torch.tensor(frame.shift, dtype=torch.float64), torch.from_numpy(frame.origin)
    away = origin - means.double().median(0).values
    return shift if (away - shift).norm() < away.norm() else torch.zeros_like(shift)


def warn_of_no_fit(path: Path, table: SplatTable, scene: Scene) -> None:
    """Say that the splats of a file, in the local frame, lie where no training camera looks."""
    if not is_in_view(table.means, scene.train):
        emit(
            Warned(
                f"{path}: no splat lies in any training view, so pictures will be empty; the file has other "
                "coordinates than the cameras of the data set: write it in those of the data set (of its COLMAP "
                "model), or name the data set that it was made from"
            )
        )


def is_in_view(means: Tensor, views: Sequence[View]) -> bool:
    """Whether the centre of a splat, (N, 3) local units, lies in the picture of one of up to MOST_VIEWS views."""
    for view in views[:: math.ceil(len(views) / MAX_SEARCHED_VIEWS)]:
        x, y, z = view.camera.project(means).unbind(1)
        inside = (z > 0) & (x >= 0) & (x <= view.camera.width) & (y >= 0) & (y <= view.camera.height)
        if bool(inside.any()):
            return True
    return False
