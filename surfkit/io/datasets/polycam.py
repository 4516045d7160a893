"""Polycam's raw data: keyframes/ with photographs, a JSON file of the camera of each, and depth maps of the LiDAR.

The layout is that of Polycam's own description (github.com/PolyCam/polyform): t_ij is row i and column j of the pose of
the camera in the world, with the axes of ARKit: of a camera x right, y up, z backward; of the world y up, in metres.
The world is turned to z up here: x, -z, y. The principal point is measured from the corner of the photograph.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import Brown, LensTable
from surfkit.io.datasets.camera_files import numbers, photographs, pose_at
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DepthFile
from surfkit.io.datasets.depth_layout import DepthLayout, DepthQuery
from surfkit.io.datasets.depth_layouts import MILLIMETRE
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.transforms import points

KEYFRAMES = "keyframes"
FOLDER_PREFIXES = ("corrected_", "")
"""What the names of folders begin with: those of optimised poses and undistorted photographs, and the others."""
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")
POSE_KEYS = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
CAMERA_KEYS = ("fx", "fy", "cx", "cy", "width", "height")
MAX_DEPTH_MM = 5000
"""Of the LiDAR of telephones; Polycam says that depths beyond are guesses."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""From x right, y up, z backward to x right, y down, z forward."""
WORLD_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From a world with y up to one with z up."""


@dataclass(frozen=True)
class Polycam(Reader):
    """Polycam's raw data: keyframes/corrected_images and corrected_cameras, or images and cameras; z up, in metres."""

    def recognises(self, root: Path) -> bool:
        return any((root / KEYFRAMES / f"{kind}cameras").is_dir() for kind in FOLDER_PREFIXES)

    def read(self, data: Data) -> RawDataset:
        folder = data.path / KEYFRAMES
        kind = next((kind for kind in FOLDER_PREFIXES if _is_filled(folder, kind)), None)
        if kind is None:
            raise BadInput(f"{folder}: no photographs with cameras in images/ and cameras/; export the raw data again")
        if not kind:
            emit(
                Warned(
                    f"{folder}: no corrected_images and corrected_cameras: poses are those of ARKit, not optimised, "
                    "and photographs have some distortion that Polycam does not tell"
                )
            )
        files = sorted((folder / f"{kind}cameras").glob("*.json"))
        named = {_photo(folder / f"{kind}images", path.stem): path for path in files}
        found, shots, lenses = photographs(data, list(named)), [], LensTable(folder)
        for name, path in named.items():
            if name in found:
                with leaving_out():
                    values = read_json(path, dict[str, Any])
                    shots.append(
                        RawImage(name, _pose(path, values), lenses.camera(str(path), _lens(path, values)), found[name])
                    )
        lenses.tell()
        return RawDataset(shots, *points(data.path, {}), metres=1.0)


@dataclass(frozen=True)
class PolycamDepth(DepthFile):
    """A depth map of the LiDAR, less what is beyond its reach; with the confidence that ARKit gives."""

    def stored(self) -> np.ndarray:
        """See `DepthFile.stored`."""
        values = super().stored()
        return np.where(values > MAX_DEPTH_MM, 0, values)

    def read_confidence(self) -> np.ndarray | None:
        """(h, w) float32: 0, 1/2 or 1, from keyframes/confidence; None where it is not there."""
        path = self.path.parents[1] / "confidence" / self.path.name
        if not path.is_file():
            return None
        return np.round(DepthFile(path, True).stored() / 127.5).astype(np.float32) / 2


@dataclass(frozen=True)
class PolycamDepths(DepthLayout):
    """Polycam: millimetres in keyframes/depth/STEM.png, up to the reach of the LiDAR, 5 m; with its confidence."""

    priority: ClassVar[int] = -4

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        folder = query.root / KEYFRAMES / "depth"
        if not folder.is_dir():
            return None
        stems = {name: PurePosixPath(name.replace("\\", "/")).stem for name in query.names}
        return {
            name: PolycamDepth(folder / f"{stem}.png", True, MILLIMETRE, metric=True) for name, stem in stems.items()
        }


def _is_filled(folder: Path, kind: str) -> bool:
    """Whether there are cameras and photographs of a kind of `FOLDER_PREFIXES`."""
    photos = (path for path in (folder / f"{kind}images").glob("*") if path.suffix in PHOTO_SUFFIXES)
    return any((folder / f"{kind}cameras").glob("*.json")) and any(photos)


def _photo(folder: Path, stem: str) -> str:
    """The photograph of a camera, below the data set."""
    end = next((end for end in PHOTO_SUFFIXES if (folder / f"{stem}{end}").is_file()), PHOTO_SUFFIXES[0])
    return f"{KEYFRAMES}/{folder.name}/{stem}{end}"


def _pose(path: Path, values: Mapping[str, Any]) -> np.ndarray:
    """(4, 4) world_to_camera, the world with z up."""
    matrix = _numbers(path, values, POSE_KEYS).reshape(3, 4)
    return pose_at(
        f"{path}: t_00 to t_23", OPENGL_TO_OPENCV @ matrix[:, :3].T @ WORLD_TO_Z_UP.T, WORLD_TO_Z_UP @ matrix[:, 3]
    )


def _lens(path: Path, values: Mapping[str, Any]) -> Brown:
    fx, fy, cx, cy, width, height = _numbers(path, values, CAMERA_KEYS).tolist()
    return Brown((round(width), round(height)), (fx, fy), (cx, cy))


def _numbers(path: Path, values: Mapping[str, Any], names: tuple[str, ...]) -> np.ndarray:
    if lacking := [name for name in names if name not in values]:
        raise BadInput(f"{path}: it lacks {', '.join(lacking)}; export the raw data again")
    return numbers(f"{path}: {names[0]} to {names[-1]}", [values[name] for name in names], len(names))
