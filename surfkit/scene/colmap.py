"""Scenes from COLMAP folders: photographs, and a sparse model in binary or text files."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.scene.camera import Camera
from surfkit.scene.data import Data, nearest
from surfkit.scene.observations import Observations, Seen
from surfkit.scene.photos import photo_size
from surfkit.scene.scene import Cloud, Frame, Scene, View

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
"""Where a model may lie, the first that is there wins."""

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
ENDS = (".bin", ".txt")
PARTS = {"cameras": 40, "images": 73, "points3D": 51}
"""The files of a model, and the fewest bytes that an entry of the binary one takes."""


@dataclass(frozen=True)
class Shot:
    """An image of the model: its name, (4, 4) world_to_camera in the input frame, and COLMAP's camera."""

    name: str
    pose: np.ndarray
    camera: Any


def library() -> Any:
    """The module pycolmap, loaded after Pillow's PNG writer: the other way round, saving a PNG kills the process."""
    import PIL.PngImagePlugin  # noqa: F401
    import pycolmap

    return pycolmap


def read(data: Data) -> Scene:
    """The scene in a COLMAP folder, in its local frame.

    Raises:
        BadInput: Something is missing, damaged, or of a kind that is not supported; one line says what to do.
    """
    root = data.path
    if not root.is_dir():
        raise BadInput(f"{root}: {'a file, not a folder' if root.exists() else 'no such folder'}; {_wanted()}")
    folder = model_folder(root)
    shots, xyz, rgb = _model(folder)
    views = _photographs(root, data, shots)
    held_out = data.held_out([shot.name for shot in shots])
    frame = Frame.around(np.stack([shot.pose for shot in shots if shot.name not in held_out]), xyz)
    views = [_view(shot, path, size, frame) for shot, (path, size) in zip(shots, views, strict=True)]
    return Scene(
        name=root.resolve().name,
        train=tuple(view for view in views if view.name not in held_out),
        held_out=tuple(view for view in views if view.name in held_out),
        cloud=Cloud(torch.from_numpy(frame.to_local(xyz).astype(np.float32)), torch.from_numpy(rgb)),
        frame=frame,
    )


def observations(data: Data, frame: Frame) -> Observations:
    """Which points of the sparse model each photograph shows, in the local frame of a scene that `read` gave."""
    folder = model_folder(data.path)
    model = _reconstruction(folder)
    points = sorted(model.points3D.items())
    row = {number: at for at, (number, _) in enumerate(points)}
    seen = {}
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        spots = [spot for spot in image.points2D if spot.point3D_id in row]
        xy = np.array([spot.xy for spot in spots], np.float64).reshape(-1, 2)
        rows = np.array([row[spot.point3D_id] for spot in spots], np.int64)
        seen[image.name] = Seen(rows, xy / (camera.width, camera.height))
    xyz = np.array([point.xyz for _, point in points], np.float64).reshape(-1, 3)
    error = np.array([point.error for _, point in points], np.float64)
    return Observations(frame.to_local(xyz), np.where(np.isfinite(xyz).all(1), error, np.inf), seen)


def _wanted() -> str:
    return f"a data set is a folder with images/ and a COLMAP model in {', '.join(MODELS[:-1])} or {MODELS[-1]}"


def model_folder(root: Path) -> Path:
    """Where the sparse model of a data set lies, or BadInput."""
    if not any(root.iterdir()):
        raise BadInput(f"{root}: the folder is empty; {_wanted()}")
    for place in MODELS:
        if any(not _lacking(root / place, end) for end in ENDS):
            return root / place
    for place in MODELS:
        lacking = min((_lacking(root / place, end) for end in ENDS), key=len)
        if len(lacking) < len(PARTS):
            raise BadInput(f"{root / place}: the COLMAP model lacks {', '.join(lacking)}; copy it whole")
    raise BadInput(f"{root}: no COLMAP model (cameras, images, points3D as .bin or .txt) in {', '.join(MODELS)}")


def _lacking(folder: Path, end: str) -> list[str]:
    return [f"{part}{end}" for part in PARTS if not (folder / f"{part}{end}").is_file()]


def _model(folder: Path) -> tuple[list[Shot], np.ndarray, np.ndarray]:
    """Shots in name order, (P, 3) float64 points in the input frame, (P, 3) uint8 colours."""
    model = _reconstruction(folder)
    shots = _shots(folder, model)
    points = [point for _, point in sorted(model.points3D.items())]
    if not points:
        raise BadInput(f"{folder}: the model has no 3D points, which training starts from; triangulate it in COLMAP")
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
    finite = np.isfinite(xyz.astype(np.float32)).all(1)
    if not finite.any():
        raise BadInput(f"{folder}: no 3D point has finite coordinates; triangulate the model again")
    if not finite.all():
        emit(Warned(f"{folder}: {(~finite).sum()} of {len(xyz)} points without finite coordinates are left out"))
    return shots, xyz[finite], rgb[finite]


def _reconstruction(folder: Path) -> Any:
    """pycolmap's model, or BadInput for one that is damaged."""
    binary = not _lacking(folder, ".bin")
    if binary:  # of text files, pycolmap sees by itself that they are cut off
        _refuse_cut_off(folder)
    try:
        model = library().Reconstruction(str(folder))
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
        if "model does not exist" in str(error):
            raise BadInput(f"{folder}: a camera model that COLMAP does not know; {_undistort()}") from error
        reason = " ".join(str(error).split())
        raise BadInput(f"{folder}: the COLMAP model is damaged: {reason}; write it again or copy it whole") from error
    cameras = sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if binary and (folder / "cameras.bin").stat().st_size < 8 + cameras:
        raise _cut_off(folder / "cameras.bin")
    return model


def _refuse_cut_off(folder: Path) -> None:
    """BadInput where a binary file ends before its entries do: pycolmap would read beyond the end, or for ever."""
    for part, least in PARTS.items():
        path = folder / f"{part}.bin"
        size = path.stat().st_size
        with path.open("rb") as file:
            count = struct.unpack("<Q", file.read(8))[0] if size >= 8 else 1
            whole = size >= 8 + count * least
            if whole and count and part in ENTRIES:
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
                    whole = ENTRIES[part](raw, count) <= size
        if not whole:
            raise _cut_off(path)


def _end_of_images(raw: mmap.mmap, count: int) -> int:
    """Where the entries end: 64 bytes, a name, and a number of observations of 24 bytes."""
    at = 8
    for _ in range(count):
        end = raw.find(b"\0", at + 64)
        if end < 0 or end + 9 > len(raw):
            return len(raw) + 1
        at = end + 9 + 24 * struct.unpack_from("<Q", raw, end + 1)[0]
    return at


def _end_of_points(raw: mmap.mmap, count: int) -> int:
    """Where the entries end: 43 bytes, and a number of observations of 8 bytes."""
    length, last, at = struct.Struct("<Q").unpack_from, len(raw) - 51, 8
    for _ in range(count):
        if at > last:
            return len(raw) + 1
        at += 51 + 8 * length(raw, at + 43)[0]
    return at


ENTRIES = {"images": _end_of_images, "points3D": _end_of_points}
"""Of the files whose entries differ in length; those of cameras are known when they are read."""


def _cut_off(path: Path) -> BadInput:
    return BadInput(f"{path}: the file is cut off or no COLMAP file; copy it whole")


def _shots(folder: Path, model: Any) -> list[Shot]:
    shots = []
    for _, image in sorted(model.images.items()):
        if not getattr(image, "has_pose", True):
            continue
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        full = np.eye(4)
        full[:3] = pose.matrix()
        if not np.isfinite(full).all():
            raise BadInput(f"{folder}: the pose of {image.name} is not finite; delete the image from the model")
        shots.append(Shot(image.name, full, model.cameras[image.camera_id]))
    if not shots:
        raise BadInput(f"{folder}: the model has no image with a pose; run COLMAP's mapper on the photographs")
    for camera_id in sorted({shot.camera.camera_id for shot in shots}):
        _refuse_camera(folder, model.cameras[camera_id])
    return sorted(shots, key=lambda shot: shot.name)


def _refuse_camera(folder: Path, camera: Any) -> None:
    where = f"{folder}: camera {camera.camera_id}"
    if camera.model.name not in PINHOLES:
        raise BadInput(f"{where} has model {camera.model.name}; only {' and '.join(PINHOLES)} work: {_undistort()}")
    focal = np.array([camera.focal_length_x, camera.focal_length_y])
    values = [*camera.params, camera.width, camera.height]
    if not (np.isfinite(values).all() and (focal > 0).all() and camera.width > 0 and camera.height > 0):
        raise BadInput(f"{where} has size {camera.width} x {camera.height} and parameters {list(camera.params)}")


def _undistort() -> str:
    return "undistort the photographs with `colmap image_undistorter`"


def _photographs(root: Path, data: Data, shots: Sequence[Shot]) -> list[tuple[Path, tuple[int, int]]]:
    """File of every photograph, and the size to use it at."""
    folder = root / (data.images or "images")
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder of photographs; put them there, or name their folder with --images")
    paths = [folder / shot.name.replace("\\", "/") for shot in shots]
    missing = [shot.name for shot, path in zip(shots, paths, strict=True) if not path.is_file()]
    if missing:
        there = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file()]
        raise BadInput(
            f"{folder}: {len(missing)} of {len(shots)} photographs of the model are missing, "
            f"the first is {missing[0]!r}{nearest(missing[0], there)}"
        )
    with ThreadPoolExecutor(4) as pool:
        sizes = list(pool.map(photo_size, paths))
    for shot, path, size in zip(shots, paths, sizes, strict=True):
        _refuse_size(shot, path, size)
    return [(path, data.size(*size)) for path, size in zip(paths, sizes, strict=True)]


def _refuse_size(shot: Shot, path: Path, size: tuple[int, int]) -> None:
    """BadInput unless the photograph is the camera's picture at some size, within a pixel."""
    full = (shot.camera.width, shot.camera.height)
    long = 0 if full[0] >= full[1] else 1
    if abs(full[1 - long] * size[long] / full[long] - size[1 - long]) <= 1:
        return
    turned = " (turned by 90 degrees)" if size[0] * full[0] == size[1] * full[1] else ""
    raise BadInput(
        f"{path}: {size[0]} x {size[1]} px{turned}, but its camera {shot.camera.camera_id} has {full[0]} x {full[1]}; "
        "use the photographs that the model was made from, whole and unturned"
    )


def _view(shot: Shot, path: Path, size: tuple[int, int], frame: Frame) -> View:
    camera = shot.camera
    full = Camera(
        world_to_camera=frame.local_pose(shot.pose),
        fx=float(camera.focal_length_x),
        fy=float(camera.focal_length_y),
        cx=float(camera.principal_point_x),
        cy=float(camera.principal_point_y),
        width=int(camera.width),
        height=int(camera.height),
    )
    return View(shot.name, full.resized(*size), path)
