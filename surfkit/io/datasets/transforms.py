"""Cameras as NeRF programs keep them: transforms.json with a pose for each frame, OpenGL axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, few, leaving_out, reject
from surfkit.core.codec import read_json
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_cloud import sample_depth_maps
from surfkit.io.datasets.depth_layout import DepthQuery, find_maps
from surfkit.io.datasets.depth_layouts import MatrixCityDepths
from surfkit.io.datasets.panoramas import panorama
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, camera_of, shorten
from surfkit.io.datasets.sparse_ply import read_points
from surfkit.io.datasets.undistort import PANORAMA_MODEL
from surfkit.scene.photo_names import name_below, named_file
from surfkit.scene.photos import photo_size

TRIED_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")
"""What may be missing at the end of a file_path."""
NUMBERED_PHOTO_FOLDERS = ("", "rgb", "images", "input")
"""Where MatrixCity's numbered photographs may lie, below their poses; or in a folder of the block's own name."""
POINT_FILES = ("sparse_pc.ply", "points3d.ply", "points3D.ply")
"""Files of sparse points that a data set need not name."""
MAX_CENTRE_RATIO, MAX_AXIS_RATIO = 1.25, 1.1
"""A principal point that is so much farther from the corner than the middle, or nearer, along both axes alike, is one
of a photograph of another size."""
MAX_FILE_NUMBER = 1e30
"""Numbers beyond it are a mistake."""
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")


@dataclass(frozen=True)
class Nerfstudio(Reader):
    """Nerfstudio: transforms.json with intrinsics, distortion, poses, masks, and sparse points in a PLY file."""

    def recognises(self, root: Path) -> bool:
        return (root / "transforms.json").is_file()

    def read(self, data: Data) -> RawDataset:
        path = data.path / "transforms.json"
        contents, shots = frames(path, data)
        held = _listed(path, contents, data, {shot.name for shot in shots})
        return RawDataset(shots, *points(data.path, contents), frozenset(held) if held else None)


@dataclass(frozen=True)
class Blender(Reader):
    """Blender renders of NeRF: transforms_train.json and transforms_test.json, which is held out."""

    def recognises(self, root: Path) -> bool:
        return (root / "transforms_train.json").is_file()

    def read(self, data: Data) -> RawDataset:
        contents, train = frames(data.path / "transforms_train.json", data)
        held: list[RawImage] = []
        for part in ("test", "val"):
            if not held and (data.path / f"transforms_{part}.json").is_file():
                held = frames(data.path / f"transforms_{part}.json", data)[1]
        matrix_city = data.path.resolve().parent.name == "pose"  # its pose/BLOCK is in hundreds of metres
        return replace(_split(train, held, points(data.path, contents)), metres=100.0 if matrix_city else None)


@dataclass(frozen=True)
class MatrixCity(Reader):
    """MatrixCity: train/BLOCK/transforms.json and test/BLOCK/transforms.json of an aerial or a street flight."""

    def recognises(self, root: Path) -> bool:
        return bool(_blocks(root / "train"))

    def read(self, data: Data) -> RawDataset:
        read = [frames(path, data) for path in _blocks(data.path / "train")]
        if not read:
            raise BadInput(f"{data.path}: no transforms.json in train/ or in a folder below it")
        train = [shot for _, shots in read for shot in shots]
        held = [shot for path in _blocks(data.path / "test") for shot in frames(path, data)[1]]
        metres, sparse = _metres(read[0][0]), points(data.path, {})
        if not len(sparse[0]):
            query = DepthQuery(data.path, [shot.name for shot in train], data.path, metres)
            sparse = sample_depth_maps(train, find_maps(query, MatrixCityDepths()))
        return replace(_split(train, held, sparse), metres=metres)


def _split(train: list[RawImage], held: list[RawImage], sparse: tuple[np.ndarray, np.ndarray]) -> RawDataset:
    return RawDataset([*train, *held], *sparse, frozenset(shot.name for shot in held) if held else None)


def _blocks(folder: Path) -> list[Path]:
    """The files of poses of one part; that of all blocks together if there is one."""
    found = [path for path in (folder / "transforms.json", *sorted(folder.glob("*/transforms.json"))) if path.is_file()]
    whole = [path for path in found if "block_all" in path.parent.name]
    return whole or found


def frames(path: Path, data: Data) -> tuple[Mapping[str, Any], list[RawImage]]:
    """What a file of transforms says, and its photographs.

    Raises:
        BadInput: It is damaged, or a photograph is missing; names the frame.
    """
    contents = read_json(path, Any)
    listed = contents.get("frames") if isinstance(contents, dict) else None
    if not isinstance(listed, list) or not listed or not all(isinstance(frame, dict) for frame in listed):
        raise BadInput(f"{path}: no list of frames in it; it is no transforms.json, or is damaged")
    cameras: dict[str, Any] = {}
    shots, read = [], []
    for at, frame in enumerate(listed):
        where = f"{path}: frames.{at}"
        with leaving_out():
            photo = _photo(where, path.parent, frame, data)
            pose = _pose(where, frame)
            camera = _camera(where, {**contents, **frame}, photo)
            camera = cameras.setdefault(str(camera), camera)  # one for all frames that share it
            mask = named_file(path.parent, str(frame["mask_path"])) if frame.get("mask_path") else None
            shots.append(RawImage(name_below(data.path, photo), pose, camera, photo, mask))
            read.append((frame, shots[-1]))
    guessed = [shot.name for frame, shot in read if _size_is_guessed({**contents, **frame})]
    if guessed:
        text = (
            f"{path}: neither w and h nor cx and cy for {len(guessed)} photographs, {few(guessed)}: focal lengths are"
        )
        emit(Warned(f"{text} taken for photographs of the size that they have now; give w and h if they were reduced"))
    if len({shot.name for shot in shots}) < len(shots):
        reject(BadInput(f"{path}: two frames have the same photograph; delete one"))
    return contents, shots


def _size_is_guessed(values: Mapping[str, Any]) -> bool:
    """Whether a focal length in pixels comes with nothing that tells of how many."""
    in_pixels = "fl_x" in values or "fl_y" in values
    return in_pixels and not ({"w", "h"} <= set(values) or {"cx", "cy"} <= set(values))


def points(root: Path, contents: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The sparse points of a data set, in the frame of its poses; none if it has none."""
    named = contents.get("ply_file_path") or next((name for name in POINT_FILES if (root / name).is_file()), None)
    with leaving_out():
        if named:
            return read_points(named_file(root, str(named)))
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def _metres(contents: Mapping[str, Any]) -> float | None:
    """Metres per unit of MatrixCity's poses: rotations of length 1/100 mean metres, whole ones hundreds of metres."""
    for frame in contents["frames"]:
        try:
            matrix = np.array(frame.get("transform_matrix", frame.get("rot_mat")), np.float64)
            return 1.0 if np.linalg.norm(matrix[:3, 0]) < 0.1 else 100.0
        except (TypeError, ValueError, IndexError):  # damaged, and told of where poses are read
            continue
    return None


def _listed(path: Path, contents: Mapping[str, Any], data: Data, names: set[str]) -> set[str]:
    """Names of the photographs that a file lists for validation or tests; a line tells of those it has no frame of."""
    found, unknown = set(), []
    for part in ("val_filenames", "test_filenames"):
        listed = contents.get(part, [])
        if not isinstance(listed, list):
            raise BadInput(f"{path}: {part} is {shorten(listed)}, not a list of photographs")
        for said in map(str, listed):
            name = None
            with suppress(BadInput):
                name = name_below(data.path, _photo(part, path.parent, {"file_path": said}, data))
            if name in names:
                found.add(name)
            else:
                unknown.append(said)
    if unknown:
        text = f"{path}: {len(unknown)} photographs listed for validation or tests are not among its frames"
        emit(Warned(f"{text}, {few(unknown)}: correct the list, or they are not held out"))
    return found


def _photo(where: str, folder: Path, frame: Mapping[str, Any], data: Data) -> Path:
    """The photograph of a frame: as its file_path says, or as its number does in MatrixCity."""
    said = str(frame.get("file_path") or "")
    index = frame.get("frame_index")
    if not said and not isinstance(index, int):
        raise BadInput(f"{where}: has no file_path")
    places: Sequence[str] = [said, said.replace("\\", "/").rpartition("/")[2]] if said else []
    if isinstance(index, int):
        numbered = f"{index:04d}.png"
        places = [*places, *(f"{below}/{numbered}".lstrip("/") for below in (*NUMBERED_PHOTO_FOLDERS, folder.name))]
    bases = [folder, *([data.path / data.images] if data.images else [])]
    for place in places:
        for base in reversed(bases):  # --images first
            for end in TRIED_SUFFIXES:
                path = named_file(base, f"{place}{end}")
                if path.is_file():
                    return path
    raise BadInput(f"{where}: no photograph {said or places[0]!r} in {folder}; put it there, or delete the frame")


def _number(where: str, values: Mapping[str, Any], name: str, default: float | None = None) -> float:
    value = values.get(name, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < MAX_FILE_NUMBER:
        raise BadInput(f"{where}: {name} is {shorten(value)}, not a number")
    return float(value)


def _camera(where: str, values: Mapping[str, Any], photo: Path) -> Any:
    """The pycolmap camera that intrinsics describe."""
    width, height = _size(where, values, photo)
    if values.get("camera_model") == PANORAMA_MODEL:
        return panorama(where, (width, height))
    fx, fy = _focal(where, values, width, height)
    centre = [_number(where, values, "cx", width / 2), _number(where, values, "cy", height / 2)]
    k = {n: _number(where, values, n, 0) for n in ("k1", "k2", "k3", "k4", "p1", "p2")}
    model = str(values.get("camera_model", "OPENCV"))
    if values.get("is_fisheye") is True or model == "OPENCV_FISHEYE":
        model, extra = "OPENCV_FISHEYE", [k["k1"], k["k2"], k["k3"], k["k4"]]
    elif model not in PERSPECTIVE:
        raise BadInput(
            f"{where}: camera_model {model}; known: {', '.join(PERSPECTIVE)}, OPENCV_FISHEYE, {PANORAMA_MODEL}"
        )
    elif k["k4"]:
        raise BadInput(f"{where}: k4 of a perspective camera means different things to different programs; drop it")
    elif not any(k.values()):
        model, extra = "PINHOLE", []
    else:
        model, extra = "FULL_OPENCV", [k["k1"], k["k2"], k["p1"], k["p2"], k["k3"], 0, 0, 0]
    return camera_of(where, model, (width, height), [fx, fy, *centre, *extra])


def _size(where: str, values: Mapping[str, Any], photo: Path) -> tuple[int, int]:
    """Width and height of a camera: those of its photograph if the file has none.

    Raises:
        BadInput: The principal point shows that the camera is one of photographs of another size.
    """
    given = {name: round(_number(where, values, name)) for name in ("w", "h") if name in values}
    if len(given) == 2:
        return given["w"], given["h"]
    size = photo_size(photo)
    for name, actual in zip(("w", "h"), size, strict=True):
        if given.get(name, actual) != actual:
            raise BadInput(f"{where}: {name} is {given[name]}, and {photo} has {size[0]} x {size[1]} px; give w and h")
    if "cx" in values and "cy" in values:
        centre = _number(where, values, "cx"), _number(where, values, "cy")
        times = [2 * at / whole for at, whole in zip(centre, size, strict=True)]
        alike = (
            min(times) > 0
            and max(times) < MAX_AXIS_RATIO * min(times)
            and not 1 / MAX_CENTRE_RATIO < times[0] < MAX_CENTRE_RATIO
        )
        if alike or not all(0 <= each <= 2 for each in times):
            raise BadInput(
                f"{where}: the principal point {centre[0]:g}, {centre[1]:g} is that of a photograph of about "
                f"{2 * centre[0]:.0f} x {2 * centre[1]:.0f} px, and {photo} has {size[0]} x {size[1]}; give w and h, "
                "the size that the cameras were found for"
            )
    return size


def _focal(where: str, values: Mapping[str, Any], width: int, height: int) -> tuple[float, float]:
    """Focal lengths in pixels, from lengths or from angles of view; one stands for both."""

    def along(axis: str, size: int) -> float | None:
        if f"fl_{axis}" in values:
            return _number(where, values, f"fl_{axis}")
        if (name := f"camera_angle_{axis}") not in values:
            return None
        angle = _number(where, values, name)
        if not 0 < angle < math.pi:
            raise BadInput(f"{where}: {name} is {angle:g}; an angle of view lies between 0 and pi")
        return size / 2 / math.tan(angle / 2)

    fx, fy = along("x", width), along("y", height)
    if fx is None and fy is None:
        raise BadInput(f"{where}: no focal length: neither fl_x nor camera_angle_x in the frame or in the file")
    return (fx if fx is not None else fy), (fy if fy is not None else fx)  # type: ignore[return-value]


def _pose(where: str, frame: Mapping[str, Any]) -> np.ndarray:
    """(4, 4) world_to_camera with OpenCV axes, of a camera_to_world with OpenGL axes, of any uniform scale."""
    given = frame.get("transform_matrix", frame.get("rot_mat"))
    try:
        matrix = np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise BadInput(f"{where}: transform_matrix is not 4 x 4 finite numbers")
    turn, centre = matrix[:3, :3], matrix[:3, 3]
    with np.errstate(all="ignore"):  # of numbers near the ends of float64; the comparison fails then
        scale = np.cbrt(np.linalg.det(turn))
        rotation = scale > 0 and np.abs(turn.T @ turn / scale**2 - np.eye(3)).max() < 1e-2
    if not rotation:
        raise BadInput(f"{where}: transform_matrix is not a rotation")
    left, _, right = np.linalg.svd(turn / scale)
    axes = left @ right @ np.diag([1.0, -1.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes.T, -axes.T @ centre
    return pose
