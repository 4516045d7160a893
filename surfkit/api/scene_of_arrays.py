"""A data set of arrays: photographs and cameras that a program holds in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from surfkit.api.dataset import Dataset, read
from surfkit.api.listen import heard
from surfkit.core.check import BadInput, expect
from surfkit.core.codec import write_json
from surfkit.core.events import Warned, emit
from surfkit.core.fit import fit

MARK = "from_arrays.json"
"""Says that a folder was written here, and may be written again."""
CONVENTION = (
    "give world to camera with x right, y down, z forward: of a camera to world with y up and z back, "
    "np.linalg.inv(pose @ np.diag([1, -1, -1, 1]))"
)
MAX_CHECKED_POINTS, MIN_SIGHTS, WRONG_POSE_RATIO = 2000, 200, 0.95
"""Points whose colours are compared with photographs; how often they must be seen for that; see `_doubt`."""
MAX_POSE_ERROR = 1e-3
"""How far a rotation may be from one: more is another matrix, such as one with a scale."""


def from_arrays(
    folder: str | Path,
    images: Sequence[Any],
    poses: Any,
    intrinsics: Any,
    points: Any = None,
    colors: Any = None,
    names: Sequence[str] | None = None,
    **options: Any,
) -> Dataset:
    """Write photographs and cameras to a folder in COLMAP's layout, and read it.

    Args:
        folder: New, empty, or written by this function before.
        images: V of (H, W, 3), uint8, or floats in [0, 1]; arrays of numpy or tensors.
        poses: (V, 4, 4) world to camera; axes of a camera: x right, y down, z forward.
        intrinsics: (3, 3), or (V, 3, 3) one for each: fx 0 cx, 0 fy cy, 0 0 1, pixels; the centre of the first pixel is
            at 0.5.
        points: (P, 3) of the surface, to start from; without any, choose a start that needs none, such as "random".
        colors: (P, 3) uint8 of the points; grey without.
        names: Of the photographs; by default 00000.png and so on.
        options: As of `read`.

    A finding tells where the colours of the points contradict the poses, as with camera-to-world ones.

    Raises:
        BadInput: An array of another shape or with other values, or a folder with other files.
    """
    root, count = fit(Path, folder, "from_arrays"), len(images)
    if root.exists() and any(root.iterdir()) and not (root / MARK).exists():
        raise BadInput(f"{root}: has files that from_arrays did not write; name a new folder")
    names = [f"{i:05d}.png" for i in range(count)] if names is None else list(names)
    if len(set(names)) != count:
        raise BadInput(f"from_arrays: {len(set(names))} different names for {count} images; give one for each")
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or not Path(name).suffix:
            raise BadInput(f"from_arrays: name {name!r}; give a file name with a suffix, such as left/00000.png")
    pictures = [_picture(f"images[{i}]", image) for i, image in enumerate(images)]
    cameras = _poses(poses, count)
    lenses = _finite("intrinsics", intrinsics)
    lenses = np.broadcast_to(lenses, (count, 3, 3)) if lenses.shape == (3, 3) else lenses
    expect("intrinsics", lenses, (count, 3, 3))
    places = _finite("points", np.zeros((0, 3)) if points is None else points)
    expect("points", places, ("P", 3))
    paint = np.full(places.shape, 128, np.uint8) if colors is None else np.asarray(colors)
    expect("colors", paint, places.shape)
    _write(root, names, pictures, cameras, lenses, places, paint)
    doubt = _doubt(pictures, cameras, lenses, places, paint) if colors is not None else None
    found = read(root, **options)
    if doubt is None:
        return found
    with heard():
        emit(Warned(doubt))
    return replace(found, findings=(*found.findings, doubt))


def _write(
    root: Path,
    names: Sequence[str],
    pictures: Sequence[np.ndarray],
    cameras: np.ndarray,
    lenses: np.ndarray,
    places: np.ndarray,
    paint: np.ndarray,
) -> None:
    """Photographs, cameras and points as COLMAP's text; shapes as of `from_arrays`."""
    model = root / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    write_json(root / MARK, {"images": len(names), "points": len(places)})
    lines: dict[str, list[str]] = {"cameras": [], "images": [], "points3D": []}
    for i, (name, picture, pose, lens) in enumerate(zip(names, pictures, cameras, lenses, strict=True), 1):
        path = root / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture).save(path)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        height, width = picture.shape[:2]
        pinhole = _row([lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2]])
        lines["cameras"].append(f"{i} PINHOLE {width} {height} {pinhole}\n")
        lines["images"].append(f"{i} {_row([w, x, y, z, *pose[:3, 3]])} {i} {name}\n\n")
    for i, (place, color) in enumerate(zip(places, list(paint), strict=True), 1):
        lines["points3D"].append(f"{i} {_row(place)} {' '.join(str(int(part)) for part in color)} 0\n")
    for part, text in lines.items():
        (model / f"{part}.txt").write_text("".join(text))


def _doubt(
    pictures: Sequence[np.ndarray], poses: np.ndarray, lenses: np.ndarray, points: np.ndarray, colors: np.ndarray
) -> str | None:
    """What is said where the colours of the points are not those of the photographs at their places; None else.

    Right poses make their difference 0.55 to 0.85 times that of points in another order, wrong ones 0.99 or more.
    """
    pick = np.random.default_rng(0).permutation(len(points))[:MAX_CHECKED_POINTS]
    places, own = points[pick], colors[pick].astype(np.float64)
    off, shuffled = [], []
    for picture, pose, lens in zip(pictures, poses, lenses, strict=True):
        seen = places @ pose[:3, :3].T + pose[:3, 3]
        rows = np.flatnonzero(seen[:, 2] > 0)
        across = seen[rows] @ lens.T
        x, y = (across[:, :2] / across[:, 2:]).T
        inside = (x >= 0) & (x < picture.shape[1]) & (y >= 0) & (y < picture.shape[0])
        there = picture[y[inside].astype(int), x[inside].astype(int)].astype(np.float64)
        rows = rows[inside]
        off.append(np.abs(there - own[rows]))
        shuffled.append(np.abs(there - np.roll(own[rows], len(rows) // 2, axis=0)))
    differences = np.concatenate(off)
    if len(differences) < MIN_SIGHTS and len(points) >= MIN_SIGHTS:
        return f"poses: hardly a camera sees any of the {len(points):,} points; {CONVENTION}"
    if len(differences) < MIN_SIGHTS or differences.mean() < WRONG_POSE_RATIO * np.concatenate(shuffled).mean():
        return None
    return f"poses: the colours of the points are not those of the photographs at their places; {CONVENTION}"


def _picture(name: str, image: Any) -> np.ndarray:
    """(H, W, 3) uint8."""
    array = np.asarray(image)
    expect(name, array, ("H", "W", 3))
    if array.dtype == np.uint8:
        return array
    if not np.issubdtype(array.dtype, np.floating) or not (array.min() >= 0 and array.max() <= 1):
        came = f"{array.dtype} from {array.min():g} to {array.max():g}"
        raise BadInput(f"{name}: {came}; give uint8, or floats from 0 to 1")
    return (array * 255).round().astype(np.uint8)


def _poses(poses: Any, count: int) -> np.ndarray:
    found = _finite("poses", poses)
    expect("poses", found, (count, 4, 4))
    for i, turn in enumerate(found[:, :3, :3]):
        if np.abs(turn @ turn.T - np.eye(3)).max() > MAX_POSE_ERROR or np.linalg.det(turn) < 0:
            raise BadInput(f"poses[{i}]: the left upper 3 x 3 is no rotation, as with a scale; {CONVENTION}")
    return found


def _finite(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values, np.float64)
    if not np.isfinite(array).all():
        raise BadInput(f"{name}: has NaN or Inf; give finite values")
    return array


def _row(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
