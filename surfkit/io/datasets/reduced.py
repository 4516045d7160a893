"""Smaller copies of photographs that a data set may hold: images_4/ beside images/, also images_3.4175/."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from surfkit.core.events import Warned, emit
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawImage
from surfkit.scene.photo_names import find_files
from surfkit.scene.photos import photo_size

IMAGES_FOLDER = "images"


def reduced(data: Data, shots: Sequence[RawImage]) -> tuple[Data, Sequence[RawImage]]:
    """The photographs in images_N/ and a data set of scale 1, where --scale N asks for these; all as it was if not.

    A note says which are used, or why they are not: one that is missing, or of another size than images/ divided by N.
    """
    if data.scale is None or data.scale == 1:
        return data, shots
    if data.images is not None:
        if _factor(data.images) == data.scale:
            text = f"the photographs in {data.images} are divided by {data.scale:g} once more; leave out --scale to use"
            emit(Warned(f"{text} them as they are"))
        return data, shots
    whole = data.path / IMAGES_FOLDER
    folder = next((path for path in sorted(data.path.glob(f"{IMAGES_FOLDER}_*")) if _factor(path) == data.scale), None)
    if folder is None or not folder.is_dir() or not all(shot.path.is_relative_to(whole) for shot in shots):
        return data, shots
    names = [shot.path.relative_to(whole).as_posix() for shot in shots]
    found = find_files(folder, names)
    if lacking := [name for name in names if name not in found]:
        emit(
            Warned(
                f"{folder} lacks {len(lacking)} of {len(shots)} photographs, {lacking[0]} for one: those in {whole} "
                "are reduced instead"
            )
        )
        return data, shots
    small = [replace(shot, path=found[name]) for shot, name in zip(shots, names, strict=True)]
    if other := _other_size(data.scale, shots, small):
        emit(Warned(f"{other}: the photographs in {whole} are reduced instead"))
        return data, shots
    emit(Warned(f"the photographs in {folder} are used, already reduced by {data.scale:g}"))
    return replace(data, scale=1.0), small


def _factor(folder: Path) -> float | None:
    """N of images_N."""
    try:
        return float(folder.name.rpartition("_")[2])
    except ValueError:
        return None


def _other_size(scale: float, shots: Sequence[RawImage], small: Sequence[RawImage]) -> str | None:
    """What is wrong with the first copy that is more than a pixel off the size of its photograph divided by scale."""
    with ThreadPoolExecutor(4) as pool:
        sizes = pool.map(photo_size, [shot.path for shot in shots])
        smaller = pool.map(photo_size, [shot.path for shot in small])
        for shot, (width, height), (w, h) in zip(small, sizes, smaller, strict=True):
            if max(abs(width / scale - w), abs(height / scale - h)) > 1:
                return f"{shot.path} has {w} x {h} px, not those of {width} x {height} divided by {scale:g}"
    return None
