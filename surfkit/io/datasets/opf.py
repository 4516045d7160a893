"""The Open Photogrammetry Format (OPF) of Pix4D: NAME.opf, which names JSON files of cameras.

By its specification (github.com/Pix4D/opf-spec), omega, phi and kappa make the rotation Rx Ry Rz from the camera (x
right, y up, z backward) to the processing system, which is the map after a scale of each axis, an exchange of x and y
where these are northing and easting, and a shift. Pixels are measured from the corner of the picture; the distortion is
that of Pix4D's other files, as OpenCV has it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from surfkit.core.check import BadInput, few, leaving_out, reject
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import Brown, LensTable
from surfkit.io.datasets.camera_files import groups_of, leave_out, numbers, one_file, photographs, pose_at, tracks_of
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.exchange_formats import map_system, photo_names
from surfkit.io.datasets.opf_points import OpfPoints, read_opf_points
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, Tracks, shorten
from surfkit.io.datasets.transforms import points

FORMAT_PATTERN = "application/opf-{}+json"
CAMERAS_FORMAT, POINTS_FORMAT = FORMAT_PATTERN.format("calibrated-cameras"), "model/gltf+json"
"""Of the calibrated cameras, and of the sparse points beside them."""
Seen = dict[str, tuple[np.ndarray, np.ndarray]]
"""By name of the photograph, rows of the points that it shows, and their pixels."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""From x right, y up, z backward to x right, y down, z forward."""


@dataclass(frozen=True)
class OPF(Reader):
    """Open Photogrammetry Format of Pix4D: NAME.opf with calibrated cameras, and images/; on the map of the project."""

    def recognises(self, root: Path) -> bool:
        return bool(_files(root))

    def read(self, data: Data) -> RawDataset:
        return _read(data)[0]

    def tracks(self, data: Data) -> Tracks | None:
        capture, seen = _read(data)
        return tracks_of(capture.shots, capture.xyz, seen) if seen else None


@dataclass(frozen=True)
class _Place:
    """Where the cameras lie.

    Attributes:
        shift: (3,) from the processing system to the map.
        crs, metres: As `RawDataset` has them.
    """

    shift: np.ndarray
    crs: str | None = None
    metres: float | None = None

    @classmethod
    def read(cls, path: Path, project: Mapping[str, Any]) -> _Place:
        """Of the reference frame of a project; that of the cameras where it has none."""
        found = _all(path, project, "scene-reference-frame")
        contents, file = next(found, (None, path))
        if contents is None:
            return cls(np.zeros(3))
        move = contents.get("base_to_canonical")
        move = move if isinstance(move, dict) else {}
        shift = -numbers(f"{file}: shift", _listed(move.get("shift", [0, 0, 0])), 3)
        scale = numbers(f"{file}: scale", _listed(move.get("scale", [1, 1, 1])), 3)
        crs = contents.get("crs")
        text = " ".join(str(crs.get("definition", "") if isinstance(crs, dict) else "").split())
        system, metres = map_system(f"{file}: {text[:40]!r}", text) if text else (None, None)
        if any(scale[:2] != 1):
            emit(Warned(f"{file}: lengths are {scale[0]:g} times those of the map: its coordinate system is left out"))
            return cls(shift, None, metres / scale[0] if metres and scale[0] > 0 else None)
        if scale[2] != 1:
            emit(Warned(f"{file}: heights are in the unit of the map, {scale[2]:g} times the numbers of its heights"))
        return cls(shift, system, metres)


def _read(data: Data) -> tuple[RawDataset, Seen]:
    """What is in a project, and where its sparse points were seen."""
    path = one_file(data.path, _files(data.path), "project NAME.opf; export the project as OPF")
    project = read_json(path, dict[str, Any])
    calibrated, file = _one(path, project, "calibrated-cameras")
    paths = {
        each.get("id"): unquote(str(each.get("uri", "")).partition("#")[0])
        for contents, _ in _all(path, project, "camera-list")
        for each in _entries(path, contents, "cameras")
    }
    sizes, taken = _inputs(path, project)
    cameras = [each for each in _entries(file, calibrated, "cameras") if each.get("id") in paths]
    if not cameras:
        raise BadInput(f"{file}: no camera in it that the list of cameras has; calibrate the project, and export it")
    counts = Counter(each["id"] for each in cameras)
    if twice := sorted({paths[number] for number, count in counts.items() if count > 1}):
        reject(BadInput(f"{file}: more than one calibration of {few(twice)}; calibrate and export the project again"))
        cameras = list({each["id"]: each for each in cameras}.values())  # to find more faults
    has = counts.keys()
    lost = [paths[each] for each in taken if each in paths and each not in has]
    leave_out(file, photo_names(lost) if lost else [], len(has) + len(lost), "are not calibrated")
    names = photo_names([paths[each["id"]] for each in cameras])
    found, shots, lenses, known = photographs(data, names), [], LensTable(file), {}
    for sensor in _entries(file, calibrated, "sensors"):
        with leaving_out():
            where = f"{file}: sensor {sensor.get('id')}"
            known[sensor.get("id")] = lenses.camera(where, _lens(where, sensor, sizes))
    lenses.tell()
    place = _Place.read(path, project)
    for name, each in zip(names, cameras, strict=True):
        if name in found and each.get("sensor_id") in known:
            with leaving_out():
                pose = _pose(f"{file}: camera {each['id']}", each, place.shift)
                shots.append(RawImage(name, pose, known[each["sensor_id"]], found[name]))
    shift = tuple(place.shift.tolist()) if any(place.shift) else None
    sparse = None
    with leaving_out():
        sparse = _sparse(path, project)
    xyz, rgb = points(data.path, {}) if sparse is None else (sparse.xyz + place.shift, sparse.rgb)
    named = {each["id"]: name for name, each in zip(names, cameras, strict=True)}
    marks = {} if sparse is None else sparse.seen
    seen = {named[number]: each for number, each in marks.items() if number in named and len(each[0])}
    _tell_of_others(file, marks, named)
    groups = groups_of(shots, seen)
    return RawDataset(shots, xyz, rgb, metres=place.metres, crs=place.crs, shift=shift, groups=groups), seen


def _sparse(path: Path, project: Mapping[str, Any]) -> OpfPoints | None:
    """The sparse points beside the calibration that is used; None where there are none."""
    items = [_entries(path, item, "resources") for item in _entries(path, project, "items")]
    used = [resources for resources in items if any(each.get("format") == CAMERAS_FORMAT for each in resources)][-1]
    file = next((_file(path, each) for each in used if each.get("format") == POINTS_FORMAT), None)
    return None if file is None else read_opf_points(file, path.parent)


def _tell_of_others(file: Path, marks: Mapping[int, tuple[np.ndarray, np.ndarray]], known: Collection[int]) -> None:
    """A line about observations in photographs that a file of calibrated cameras does not have."""
    counts = {number: len(rows) for number, (rows, _) in marks.items()}
    lost, whole = sum(count for number, count in counts.items() if number not in known), sum(counts.values())
    if lost and lost == whole:
        emit(
            Warned(
                f"{file}: lacks the cameras that all {whole:,} observations of the sparse points name, so the points "
                "are of another calibration, and which photographs show them is not known; export the project again"
            )
        )
    elif lost:
        emit(
            Warned(
                f"{file}: lacks the cameras that {lost:,} of {whole:,} observations of the sparse points name: these "
                "are left out"
            )
        )


def _files(root: Path) -> list[Path]:
    return sorted(path for path in root.glob("*.opf") if path.is_file() and not path.name.startswith("."))


def _all(path: Path, project: Mapping[str, Any], kind: str) -> Iterator[tuple[Mapping[str, Any], Path]]:
    """The contents of the files of a kind that a project names, and their paths."""
    for item in _entries(path, project, "items"):
        for resource in _entries(path, item, "resources"):
            if resource.get("format") == FORMAT_PATTERN.format(kind):
                file = _file(path, resource)
                yield read_json(file, dict[str, Any]), file


def _file(path: Path, resource: Mapping[str, Any]) -> Path:
    """The file of a resource of a project."""
    uri = unquote(str(resource.get("uri", "")))
    if "://" in uri and not uri.startswith("file:"):
        raise BadInput(f"{path}: {shorten(uri)} is not on this machine; save the project whole")
    return path.parent / uri.removeprefix("file://").replace("\\", "/")


def _one(path: Path, project: Mapping[str, Any], kind: str) -> tuple[Mapping[str, Any], Path]:
    found = list(_all(path, project, kind))
    if not found:
        raise BadInput(f"{path}: names no file of {kind}; calibrate the project, and export it as OPF again")
    if len(found) > 1:
        emit(Warned(f"{path} has {len(found)} calibrations; the last, {found[-1][1].name!r}, is used"))
    return found[-1]


def _entries(path: Path, contents: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    listed = contents.get(name, [])
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
        raise BadInput(f"{path}: {name} is no list of objects; export the project again")
    return listed


def _inputs(path: Path, project: Mapping[str, Any]) -> tuple[dict[Any, Any], list[Any]]:
    """The sizes of the photographs of each sensor, and the numbers of all cameras that took one."""
    sizes: dict[Any, Any] = {}
    taken: list[Any] = []
    for contents, file in _all(path, project, "input-cameras"):
        sizes |= {each.get("id"): each.get("image_size_px") for each in _entries(file, contents, "sensors")}
        for capture in _entries(file, contents, "captures"):
            taken += [each.get("id") for each in _entries(file, capture, "cameras")]
    return sizes, taken


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _pose(where: str, camera: Mapping[str, Any], shift: np.ndarray) -> np.ndarray:
    """(4, 4) world_to_camera on the map."""
    degrees = numbers(f"{where}: orientation_deg", _listed(camera.get("orientation_deg")), 3)
    position = numbers(f"{where}: position", _listed(camera.get("position")), 3)
    (co, cp, ck), (so, sp, sk) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, co, -so], [0, so, co]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[ck, -sk, 0], [sk, ck, 0], [0, 0, 1]])
    return pose_at(where, OPENGL_TO_OPENCV @ (about_x @ about_y @ about_z).T, position + shift)


def _lens(where: str, sensor: Mapping[str, Any], sizes: Mapping[Any, Any]) -> Brown:
    found = sensor.get("internals")
    inner: Any = found if isinstance(found, dict) else {}
    if (kind := inner.get("type")) != "perspective":
        raise BadInput(f"{where}: of type {shorten(kind)}; only perspective is read: use undistorted photographs")
    if sensor.get("id") not in sizes:
        raise BadInput(f"{where}: the input cameras do not have it, and so not the size of its photographs")
    width, height = numbers(f"{where}: image_size_px", _listed(sizes[sensor["id"]]), 2).tolist()
    focal = float(numbers(f"{where}: focal_length_px", [inner.get("focal_length_px")], 1)[0])
    u, v = numbers(f"{where}: principal_point_px", _listed(inner.get("principal_point_px")), 2).tolist()
    k1, k2, k3 = numbers(f"{where}: radial_distortion", _listed(inner.get("radial_distortion", [0.0] * 3)), 3).tolist()
    p1, p2 = numbers(
        f"{where}: tangential_distortion", _listed(inner.get("tangential_distortion", [0.0] * 2)), 2
    ).tolist()
    return Brown((round(width), round(height)), (focal, focal), (u, v), (k1, k2, k3, 0.0), (p1, p2))
