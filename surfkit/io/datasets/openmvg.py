"""OpenMVG: sfm_data.json with views, intrinsics, extrinsics, and sparse points with their observations.

The layout is that of openMVG's `sfm_data_io_cereal.cpp`: JSON of the library cereal, in which an intrinsic carries its
kind where that comes first, and only its number afterwards. Pixels are counted so that the centre of the first is 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.codec import read_json
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import Brown
from surfkit.io.datasets.camera_files import (
    MAX_CAMERA_NUMBER,
    groups_of,
    leave_out,
    numbers,
    photographs,
    pose_at,
    tracks_of,
)
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, Tracks, shorten

SFM_DATA_FILES = (
    "sfm_data.json",
    "reconstruction/sfm_data.json",
    "reconstruction_sequential/sfm_data.json",
    "reconstruction_global/sfm_data.json",
)
"""Where the file may lie, the first that is there wins."""
INTRINSIC_FIELDS = {
    "pinhole": ("", 0),
    "pinhole_radial_k1": ("disto_k1", 1),
    "pinhole_radial_k3": ("disto_k3", 3),
    "pinhole_brown_t2": ("disto_t2", 5),
    "fisheye": ("fisheye", 4),
}
"""Field of the coefficients of each kind of intrinsic, and how many there are."""
NEW_KIND_FLAG = 1 << 31
"""Is added to the number of a kind where its name follows."""
FIRST_PIXEL_CENTRE = 0.5
"""Centre of the first pixel, where OpenMVG counts 0."""
POINT_GREY = 128
"""Colour of points: the file has none."""
DAMAGE_ERRORS = (KeyError, TypeError, ValueError, AttributeError, OverflowError, IndexError)


@dataclass(frozen=True)
class OpenMVG(Reader):
    """OpenMVG: sfm_data.json with intrinsics and extrinsics, and images/; sparse points with their tracks."""

    def recognises(self, root: Path) -> bool:
        return any((root / place).is_file() for place in SFM_DATA_FILES)

    def read(self, data: Data) -> RawDataset:
        file = _SfmData.read(data)
        shots, (xyz, seen) = file.shots(data), file.points()
        return RawDataset(shots, xyz, np.full(xyz.shape, POINT_GREY, np.uint8), groups=groups_of(shots, seen))

    def tracks(self, data: Data) -> Tracks:
        file = _SfmData.read(data)
        return tracks_of(file.shots(data), *file.points())


@dataclass(frozen=True)
class _SfmData:
    """What the file says.

    Attributes:
        path: Of the file.
        parts: Its lists, by name: (key, value) of each entry.
        names: Of the photographs, by the key of their view.
    """

    path: Path
    parts: Mapping[str, list[tuple[Any, Any]]]
    names: Mapping[Any, str]

    @classmethod
    def read(cls, data: Data) -> _SfmData:
        """The file of a data set, or BadInput."""
        path = next(
            (data.path / place for place in SFM_DATA_FILES if (data.path / place).is_file()),
            data.path / SFM_DATA_FILES[0],
        )
        contents = read_json(path, Any)
        try:
            parts = {
                name: [(entry["key"], entry["value"]) for entry in contents.get(name) or []]
                for name in ("views", "intrinsics", "extrinsics", "structure")
            }
            names = {key: _name(value) for key, value in parts["views"]}
        except DAMAGE_ERRORS as error:
            raise _damaged(path, error) from error
        for name, how in (
            ("views", "list the photographs"),
            ("extrinsics", "reconstruct"),
            ("intrinsics", "reconstruct"),
        ):
            if not parts[name]:
                raise BadInput(
                    f"{path}: no {name} in it; {how} with OpenMVG, and convert the result with ConvertSfM_DataFormat"
                )
        return cls(path, parts, names)

    def shots(self, data: Data) -> list[RawImage]:
        """The photographs with a pose."""
        try:
            lenses = self._lenses()
            poses = dict(self.parts["extrinsics"])
            views = [(self.names[key], value["ptr_wrapper"]["data"]) for key, value in self.parts["views"]]
            placed = [
                (name, view) for name, view in views if view["id_pose"] in poses and view["id_intrinsic"] in lenses
            ]
            without = [
                name for name, view in views if view["id_pose"] not in poses or view["id_intrinsic"] not in lenses
            ]
            leave_out(self.path, without, len(views), "have no pose or no intrinsic")
            found, shots = photographs(data, [name for name, _ in placed]), []
            for name, view in placed:
                if name in found:
                    with leaving_out():
                        pose = self._pose(name, poses[view["id_pose"]])
                        shots.append(RawImage(name, pose, lenses[view["id_intrinsic"]], found[name]))
        except DAMAGE_ERRORS as error:
            if isinstance(error, BadInput):
                raise
            raise _damaged(self.path, error) from error
        return shots

    def points(self) -> tuple[np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
        """(P, 3) points; by name of the photograph, rows of those that it shows, and their pixels."""
        try:
            xyz = np.array([value["X"] for _, value in self.parts["structure"]], np.float64).reshape(-1, 3)
            sights = [
                (row, self.names[seen["key"]], *seen["value"]["x"])
                for row, (_, value) in enumerate(self.parts["structure"])
                for seen in value["observations"]
                if seen["key"] in self.names
            ]
            pixels = np.array([sight[2:] for sight in sights], np.float64).reshape(-1, 2) + FIRST_PIXEL_CENTRE
        except DAMAGE_ERRORS as error:
            raise _damaged(self.path, error) from error
        good = np.all(np.abs(xyz) < MAX_CAMERA_NUMBER, axis=1)
        kept = np.where(good, np.cumsum(good) - 1, -1)
        rows = np.array([sight[0] for sight in sights], np.int64)
        listed: dict[str, list[int]] = {}
        for at in np.flatnonzero(good[rows] & np.isfinite(pixels).all(1)).tolist():
            listed.setdefault(sights[at][1], []).append(at)
        return xyz[good], {name: (kept[rows[at]], pixels[at]) for name, at in listed.items()}

    def _lenses(self) -> dict[Any, Any]:
        """The cameras, by the key of their intrinsic."""
        kinds: dict[int, str] = {}
        lenses: dict[Any, Any] = {}
        for key, value in self.parts["intrinsics"]:
            number = int(value["polymorphic_id"])
            if "polymorphic_name" in value:
                kinds[number % NEW_KIND_FLAG] = str(value["polymorphic_name"])
            kind = kinds.get(number % NEW_KIND_FLAG, f"number {number}")
            with leaving_out():
                lenses[key] = _camera(f"{self.path}: intrinsic {shorten(key)}", kind, value["ptr_wrapper"]["data"])
        return lenses

    def _pose(self, name: str, pose: Mapping[str, Any]) -> np.ndarray:
        where = f"{self.path}: pose of {name!r}"
        turn = np.stack([numbers(where, row, 3) for row in pose["rotation"]])
        if turn.shape != (3, 3):
            raise BadInput(f"{where}: the rotation has no three rows")
        return pose_at(where, turn, numbers(where, pose["center"], 3))


def _name(view: Mapping[str, Any]) -> str:
    """The photograph of a view, below the folder of the photographs."""
    data = view["ptr_wrapper"]["data"]
    folder = str(data.get("local_path") or "").replace("\\", "/").strip("/")
    return f"{folder}/{data['filename']}" if folder else str(data["filename"])


def _camera(where: str, kind: str, values: Mapping[str, Any]) -> Any:
    """The pycolmap camera of an intrinsic."""
    if kind not in INTRINSIC_FIELDS:
        raise BadInput(f"{where}: of kind {kind}; known: {', '.join(INTRINSIC_FIELDS)}; cut up panoramas")
    field, count = INTRINSIC_FIELDS[kind]
    focal = float(numbers(where, [values["focal_length"]], 1)[0])
    u, v = numbers(where, values["principal_point"], 2) + FIRST_PIXEL_CENTRE
    given = [float(value) for value in numbers(where, values[field], count)] if count else []
    size = (int(values["width"]), int(values["height"]))
    if kind == "fisheye":
        k1, k2, k3, k4 = given
        return Brown(size, (focal, focal), (u, v), (k1, k2, k3, k4), fisheye=True).camera(where)[0]
    k1, k2, k3, t1, t2 = [*given, *(0.0,) * (5 - count)]
    return Brown(size, (focal, focal), (u, v), (k1, k2, k3, 0.0), (t1, t2)).camera(where)[0]


def _damaged(path: Path, error: Exception) -> BadInput:
    said = f"{type(error).__name__} {shorten(str(error))}"
    return BadInput(f"{path}: damaged, or not of OpenMVG: {said}; convert the result again with ConvertSfM_DataFormat")
