"""Record3D: an unpacked .r3d file, with a file of metadata and photographs in rgbd/.

Poses are a quaternion (x, y, z, w) and a place, of the camera in the world, with the axes of ARKit: of a camera x
right, y up, z backward; of the world y up, in metres. The world is turned to z up here: x, -z, y. K is listed by
columns. Depth is compressed by LZFSE, and is not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.camera_files import numbers, photographs, pose_at
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.polycam import OPENGL_TO_OPENCV, WORLD_TO_Z_UP
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, camera_of
from surfkit.io.datasets.transforms import points

METADATA_FILES = ("metadata", "metadata.json")
PHOTOS_FOLDER = "rgbd"
PACKED_SUFFIX = ".r3d"


@dataclass(frozen=True)
class Record3D(Reader):
    """Record3D: an unpacked .r3d file (unzip NAME.r3d), with metadata and rgbd/; z up, in metres."""

    def recognises(self, root: Path) -> bool:
        return _file(root) is not None or _packed(root) is not None

    def read(self, data: Data) -> RawDataset:
        path, folder = _file(data.path), data.path / PHOTOS_FOLDER
        if path is None:
            packed = _packed(data.path)
            how = f"unpack {packed.name} there: it is a zip archive" if packed else "unpack the .r3d file there"
            raise BadInput(f"{data.path}: no {' or '.join(METADATA_FILES)} beside {PHOTOS_FOLDER}/; {how}")
        values = read_json(path, dict[str, Any])
        if lacking := [name for name in ("w", "h", "K", "poses") if name not in values]:
            raise BadInput(f"{path}: it lacks {', '.join(lacking)}; export from Record3D again")
        poses, own = values["poses"], values.get("perFrameIntrinsicCoeffs") or None
        if not isinstance(poses, list) or not poses:
            raise BadInput(f"{path}: no list of poses; record with camera poses, and export again")
        if own is not None and not (isinstance(own, list) and len(own) == len(poses)):
            raise BadInput(
                f"{path}: perFrameIntrinsicCoeffs is no list of a lens for each of {len(poses)} poses; export again"
            )
        names = [f"{PHOTOS_FOLDER}/{at}.jpg" for at in range(len(poses))]
        found, shots = photographs(data, names, PHOTOS_FOLDER), []
        known: dict[str, Any] = {}
        width, height = (round(side) for side in numbers(f"{path}: w, h", [values["w"], values["h"]], 2).tolist())
        k = numbers(f"{path}: K", values["K"], 9).reshape(3, 3).T
        for at, name in enumerate(names):
            if name in found:
                with leaving_out():
                    lens = [k[0, 0], k[1, 1], k[0, 2], k[1, 2]]
                    if own is not None:
                        lens = numbers(f"{path}: perFrameIntrinsicCoeffs.{at}", own[at], 4).tolist()
                    camera = camera_of(f"{path}: poses.{at}", "PINHOLE", (width, height), lens)
                    camera = known.setdefault(str(camera), camera)  # one for all that share it
                    shots.append(RawImage(name, _pose(f"{path}: poses.{at}", poses[at]), camera, found[name]))
        if any(folder.glob("*.depth")):
            emit(Warned(f"{folder}: depth of Record3D is compressed by LZFSE, and is not read"))
        return RawDataset(shots, *points(data.path, {}), metres=1.0)


def _file(root: Path) -> Path | None:
    """The file of metadata, if there are photographs beside it."""
    return next(
        (root / name for name in METADATA_FILES if (root / name).is_file() and (root / PHOTOS_FOLDER).is_dir()), None
    )


def _packed(root: Path) -> Path | None:
    return next(iter(sorted(root.glob(f"*{PACKED_SUFFIX}"))), None)


def _pose(where: str, given: Any) -> np.ndarray:
    """(4, 4) world_to_camera, the world with z up."""
    from scipy.spatial.transform import Rotation

    values = numbers(where, given, 7)
    if not np.linalg.norm(values[:4]) > 0.5:
        raise BadInput(f"{where}: its first four numbers are no quaternion; export from Record3D again")
    return pose_at(
        where,
        OPENGL_TO_OPENCV @ Rotation.from_quat(values[:4]).as_matrix().T @ WORLD_TO_Z_UP.T,
        WORLD_TO_Z_UP @ values[4:],
    )
