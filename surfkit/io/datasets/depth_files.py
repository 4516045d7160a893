"""Depth maps on disk: what their numbers mean, and the ones that surfkit writes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.files import replacing
from surfkit.core.optional import needed
from surfkit.scene.arrays import map_array, write_array
from surfkit.scene.photo_names import safe_path
from surfkit.scene.photos import open_picture

EXR = ".exr"
NO_DEPTH = 65504.0
"""The largest half float: the sky in MatrixCity's depth maps."""
DEPTH_FOLDER = "estimated_depths"
DEPTH_RECORD = "depth.json"
PATH_FIELDS = ("path", "straight")
"""Fields of a depth file that say nothing of its numbers."""
NORMAL_SCALE = 127
"""What a component of 1 of a normal is stored as."""
warnings.filterwarnings("ignore", r"Reading `\.npy`", UserWarning)  # of Python 2, whose arrays are as good


@dataclass(frozen=True)
class DepthFile:
    """A depth map on disk: a .npy file, an OpenEXR file or a picture of one channel.

    For files of another format, a `DepthLayout` returns a subclass that overrides `stored`. What else decides the
    meaning of the numbers must be a field, so that a run notices when it changes.

    Attributes:
        path: Of the map.
        aligned: Whether `read` gives inverse depth in input units; otherwise it is fitted to the sparse points.
        scale: Stored values are multiplied by it; where `metric`, before they are inverted.
        offset: Added after that; unused where `metric`.
        metric: Whether depths are stored, not inverse depths.
        straight: Whether the map is of the undistorted photograph, as surfkit makes them, and not of the one in the
            data set, with which it is undistorted.
    """

    path: Path
    aligned: bool
    scale: float = 1.0
    offset: float = 0.0
    metric: bool = False
    straight: bool = False

    def stored(self) -> np.ndarray:
        """The numbers in the file, (h, w), (1, h, w) or (h, w, 1).

        Raises:
            BadInput: The file is not a map; says why in a few words.
        """
        return _stored(self.path)

    @property
    def meaning(self) -> tuple[Any, ...]:
        """Everything but the file that decides what `read` gives."""
        return tuple(getattr(self, field.name) for field in fields(self) if field.name not in PATH_FIELDS)

    def read(self) -> np.ndarray:
        """(h, w) float32 inverse depth, up to an affine map unless `aligned`; NaN where there is none.

        Raises:
            BadInput: The file is not a map; says why in a few words.
        """
        stored = self.stored()
        if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[-1]):
            stored = stored.reshape([size for size in stored.shape if size != 1] or [1, 1])
        if stored.ndim != 2:
            raise BadInput(f"has shape {stored.shape}, not (height, width)")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            values = stored.astype(np.float32)
            if self.metric:
                return np.where(values > 0, 1 / (values * np.float32(self.scale)), np.nan)
            inverse = np.where(np.isfinite(values) & (values != 0), values * self.scale + self.offset, np.nan)
        return inverse.astype(np.float32)

    def read_confidence(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1] from the file `<image>.confidence.npy` beside the map; None where there is none."""
        path = confidence_path(self.path)
        if not path.exists():
            return None
        stored = _stored(path)
        if stored.ndim != 2:
            raise BadInput(f"confidence has shape {stored.shape}, not (height, width)")
        values = stored.astype(np.float32) / (255 if stored.dtype == np.uint8 else 1)
        return np.nan_to_num(values).clip(0, 1)

    def read_normal(self) -> np.ndarray | None:
        """(3, h, w) int8 from the file `<image>.normal.npy` beside the map; None where there is none.

        They are normals of the surface times 127, in the camera's axes and towards the camera; 0 where there is none.
        """
        path = normal_path(self.path)
        if not path.exists():
            return None
        stored = _stored(path)
        if stored.ndim != 3 or len(stored) != 3 or stored.dtype != np.int8:
            raise BadInput(f"normals are {stored.dtype} of shape {stored.shape}, not int8 of (3, height, width)")
        return stored


def map_path(root: Path, name: str) -> Path:
    """Where surfkit and CityGaussianV2 keep the inverse depth of a photograph, whose name may lead anywhere."""
    path = root / DEPTH_FOLDER / safe_path(name)
    return path.with_name(f"{path.name}.npy")


def confidence_path(path: Path) -> Path:
    """The confidence that belongs to a map."""
    return path.with_name(f"{path.name.removesuffix('.npy')}.confidence.npy")


def normal_path(path: Path) -> Path:
    """The normals that belong to a map."""
    return path.with_name(f"{path.name.removesuffix('.npy')}.normal.npy")


def write_map(
    root: Path, name: str, inverse: np.ndarray, confidence: np.ndarray, normal: np.ndarray | None = None
) -> None:
    """Save a map and what belongs to it; the map comes last and is whole or not there, also when the process dies.

    Args:
        root: The data set.
        name: Of the photograph.
        inverse: (h, w) inverse depth; 0 where there is none.
        confidence: (h, w) in [0, 1].
        normal: (3, h, w) unit normals of the surface in the camera's axes, towards the camera; 0 where there is none.
    """
    path = map_path(root, name)
    save_array(confidence_path(path), (confidence.clip(0, 1) * 255).round().astype(np.uint8))
    if normal is None:
        normal_path(path).unlink(missing_ok=True)
    else:
        save_array(normal_path(path), (normal.clip(-1, 1) * NORMAL_SCALE).round().astype(np.int8))
    save_array(path, inverse.astype(np.float32))


def is_whole(path: Path, oriented: bool) -> bool:
    """Whether a map that surfkit wrote, and its confidence, can be opened and have one size; numbers are not looked at.

    Args:
        path: Of the map.
        oriented: Whether it must have normals.
    """
    try:
        depth, confidence = map_array(path), map_array(confidence_path(path))
        normal = map_array(normal_path(path)) if oriented else None
    except Exception:  # it is not there, or damaged, of which numpy raises whatever comes
        return False
    if depth.ndim != 2 or depth.dtype != np.float32 or confidence.dtype != np.uint8:
        return False
    whole = normal is None or (normal.dtype == np.int8 and normal.shape == (3, *depth.shape))
    return whole and confidence.shape == depth.shape


def read_record(root: Path) -> Mapping[str, Any]:
    """What made the maps of a data set, from estimated_depths/depth.json; empty where other programs made them."""
    path = root / DEPTH_FOLDER / DEPTH_RECORD
    if not path.exists():
        return {}
    try:
        return read_json(path, dict[str, Any])
    except BadInput as error:
        raise BadInput(f"{error}; it says what made the maps: delete it or make them again") from error


def write_record(root: Path, record: Mapping[str, Any]) -> None:
    """Say what made the maps."""
    write_json(root / DEPTH_FOLDER / DEPTH_RECORD, record)


def save_array(path: Path, values: np.ndarray) -> None:
    """Save numbers as .npy; the file is whole or not there."""
    with replacing(path) as file:
        write_array(file, values)


def _stored(path: Path) -> np.ndarray:
    """The numbers in a .npy file or in a picture of one channel."""
    if path.suffix.lower() == EXR:
        return _exr(path)
    if path.suffix.lower() == ".npy":
        return _array(path)
    try:
        return open_picture(path, np.array)
    except BadInput as error:
        raise BadInput(f"cannot be read: {str(error).removeprefix(f'{path}: ')}") from error


def _array(path: Path) -> np.ndarray:
    """The numbers in a .npy file, mapped from disk."""
    try:
        stored = map_array(path)
    except Exception as error:
        raise BadInput(f"cannot be read: {' '.join(str(error).split())}") from error
    if stored.dtype.kind not in "fiub" or not stored.size:
        raise BadInput(f"cannot be read: it holds {stored.size} times {stored.dtype}, not numbers")
    return stored


def _exr(path: Path) -> np.ndarray:
    """(h, w) float32, the red or only channel of an OpenEXR file; 0 where that is the largest half float."""
    with needed("OpenEXR", "an .exr file"):
        import OpenEXR
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except (RuntimeError, ValueError, OSError) as error:
        raise BadInput(f"cannot be read: {' '.join(str(error).split())}") from error
    first = next((channels[name] for name in ("R", "Y", "Z", "V") if name in channels), None)
    if first is None:
        raise BadInput(f"has channels {', '.join(channels)}, none of R, Y, Z, V")
    values = first.pixels.astype(np.float32)
    none = values >= NO_DEPTH if first.pixels.dtype == np.float16 else values == NO_DEPTH
    return np.where(none, 0, values)
