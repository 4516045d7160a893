"""COLMAP folders: photographs, and a sparse model in binary or text files."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from surfkit.core.check import BadInput, reject
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.colmap_files import MIN_ENTRY_BYTES, SPOT, cut_off, refuse_cut_off, spots_of_images
from surfkit.io.datasets.data import Data, nearest
from surfkit.io.datasets.georeference_file import Georeference, on_the_map, read_placed
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, Tracks, load_pycolmap
from surfkit.scene.connected_photos import connect_groups
from surfkit.scene.photo_names import find_files

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
"""Where a model may lie, the first that is there wins."""

MODEL_PARENT_FOLDERS = ("sparse", "colmap/sparse")
"""Where COLMAP numbers the models of photographs that it could not connect."""
MODEL_SUFFIXES = (".bin", ".txt")
NO_POINT = np.uint64(2**64 - 1)
"""Number of the sparse point of a feature that has none."""


@dataclass(frozen=True)
class COLMAP(Reader):
    """COLMAP: images/ and a sparse model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, binary or text."""

    priority: ClassVar[int] = 1  # other layouts have no observations of the sparse points, which aligned priors need

    def recognises(self, root: Path) -> bool:
        return any(
            len(_lacking(place, end)) < len(MIN_ENTRY_BYTES) for place in _places(root) for end in MODEL_SUFFIXES
        )

    def read(self, data: Data) -> RawDataset:
        folder = self.model_folder(data)
        if data.model is None and len(models := _beside(folder)) > 1:
            counts = ", ".join(f"{place.relative_to(data.path)} of {_images(place)}" for place in models)
            emit(
                Warned(
                    f"{data.path} has several models, each of photographs of its own: {counts}; "
                    f"{folder.relative_to(data.path)} is used, choose another with --model"
                )
            )
        images, xyz, rgb, groups = _model(folder)
        paths = _photographs(data.path, data, [image.name for image in images])
        pairs = [(image, path) for image, path in zip(images, paths, strict=True) if path is not None]
        shots = [RawImage(image.name, image.pose, image.camera, path) for image, path in pairs]
        capture = RawDataset(shots, xyz, rgb, groups=groups, numbered=True)
        placed = _placed(data.path, folder)
        return capture if placed is None else on_the_map(capture, placed)

    def model_folder(self, data: Data) -> Path:
        return _largest(data.path) if data.model is None else _named(data.path / data.model)

    def tracks(self, data: Data) -> Tracks:
        folder = self.model_folder(data)
        model, placed = _reconstruction(folder), _placed(data.path, folder)
        points = sorted(model.points3D.items())
        spots, numbers = _spots(folder, model), np.array([number for number, _ in points], np.uint64)
        seen = {}
        for number, image in model.images.items():
            xy, shown = spots[number]["xy"], spots[number]["point"]
            rows = np.searchsorted(numbers, shown)
            known = np.append(numbers, NO_POINT)[rows] == shown
            known &= shown != NO_POINT
            seen[image.name] = (rows[known], np.array(xy[known], np.float64))
        xyz = np.array([point.xyz for _, point in points], np.float64).reshape(-1, 3)
        xyz += 0 if placed is None else placed.offset
        error = np.array([point.error for _, point in points], np.float64)
        cameras = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
        return Tracks(xyz, np.where(np.isfinite(xyz).all(1), error, np.inf), seen, cameras)


def _spots(folder: Path, model: Any) -> dict[int, np.ndarray]:
    """(K,) `SPOT` of each image of a model, by its number."""
    if not _lacking(folder, ".bin"):
        return spots_of_images(folder / "images.bin")
    return {
        number: np.array([(spot.xy, spot.point3D_id) for spot in image.points2D], SPOT)
        for number, image in model.images.items()
    }


@dataclass(frozen=True)
class ColmapImage:
    """An image of the model: its name, (4, 4) world_to_camera in the input frame, and COLMAP's camera."""

    name: str
    pose: np.ndarray
    camera: Any


def _placed(root: Path, folder: Path) -> Georeference | None:
    """Where a model lies, by a file beside it or in a folder above it, up to that of the data set."""
    above = folder.relative_to(root).parts if folder.is_relative_to(root) else ()
    return read_placed(folder, *(root.joinpath(*above[:depth]) for depth in range(len(above))), root)


def _places(root: Path) -> list[Path]:
    """Where a model may lie: the usual places, and any numbered folders beside them."""
    numbered = [path for base in MODEL_PARENT_FOLDERS for path in sorted((root / base).glob("[0-9]*")) if path.is_dir()]
    return list(dict.fromkeys([*(root / place for place in MODEL_FOLDERS), *numbered]))


def _largest(root: Path) -> Path:
    """Where the sparse model of a data set lies, that of most photographs if there are several, or BadInput."""
    whole = next((place for place in _places(root) if _is_whole(place)), None)
    if whole is not None:
        return max(_beside(whole), key=_images)
    for place in _places(root):
        _refuse_torn(place)
    raise BadInput(f"{root}: no COLMAP model (cameras, images, points3D as .bin or .txt) in {', '.join(MODEL_FOLDERS)}")


def _named(place: Path) -> Path:
    """The folder of the model that the user names, or BadInput."""
    if not _is_whole(place):
        _refuse_torn(place)
        raise BadInput(f"--model {place}: no COLMAP model (cameras, images, points3D as .bin or .txt) there")
    return place


def _beside(place: Path) -> list[Path]:
    """A model and the other numbered ones beside it."""
    if not place.name.isdigit():
        return [place]
    return [path for path in sorted(place.parent.iterdir()) if path.name.isdigit() and _is_whole(path)]


def _is_whole(place: Path) -> bool:
    return any(not _lacking(place, end) for end in MODEL_SUFFIXES)


def _refuse_torn(place: Path) -> None:
    """BadInput if a folder has some of the files of a model."""
    lacking = min((_lacking(place, end) for end in MODEL_SUFFIXES), key=len)
    if len(lacking) < len(MIN_ENTRY_BYTES):
        raise BadInput(f"{place}: the COLMAP model lacks {', '.join(lacking)}; copy it whole")


def _images(folder: Path) -> int:
    """How many images a model has, without reading all of it."""
    if not _lacking(folder, ".bin"):
        with (folder / "images.bin").open("rb") as file:
            raw = file.read(8)
        return struct.unpack("<Q", raw)[0] if len(raw) == 8 else 0
    with (folder / "images.txt").open("rb") as file:
        return sum(not line.startswith(b"#") for line in file) // 2


def _lacking(folder: Path, end: str) -> list[str]:
    return [f"{part}{end}" for part in MIN_ENTRY_BYTES if not (folder / f"{part}{end}").is_file()]


def _model(folder: Path) -> tuple[list[ColmapImage], np.ndarray, np.ndarray, list[list[str]]]:
    """Images in the order of their numbers, (P, 3) float64 points in the input frame, (P, 3) uint8 colours, groups."""
    model = _reconstruction(folder)
    shots = _shots(folder, model)
    points = [point for _, point in sorted(model.points3D.items())]
    xyz = np.array([point.xyz for point in points], np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
    with np.errstate(over="ignore"):
        finite = np.isfinite(xyz.astype(np.float32)).all(1)
    if not points and any(image.num_points3D for image in model.images.values()):
        reject(
            BadInput(f"{folder}: its images refer to 3D points, and the file of points has none; copy the model whole")
        )
    if points and not finite.any():
        reject(BadInput(f"{folder}: no 3D point has finite coordinates; triangulate the model again"))
    elif not finite.all():
        emit(Warned(f"{folder}: {(~finite).sum()} of {len(xyz)} points without finite coordinates are left out"))
    return shots, xyz[finite], rgb[finite], _groups(model, points)


def _groups(model: Any, points: Sequence[Any]) -> list[list[str]]:
    """Names of the images that points connect, as `RawDataset` has them."""
    observed = [(number, image.name) for number, image in sorted(model.images.items()) if image.num_points3D]
    place = {number: at for at, (number, _) in enumerate(observed)}
    shuffled = (points[at] for at in np.random.default_rng(0).permutation(len(points)))  # their order is that of images
    tracks = ([place[e.image_id] for e in point.track.elements if e.image_id in place] for point in shuffled)
    return [[observed[at][1] for at in group] for group in connect_groups(len(observed), tracks)]


def _reconstruction(folder: Path) -> Any:
    """pycolmap's model, or BadInput for one that is damaged."""
    binary = not _lacking(folder, ".bin")
    if binary:  # of text files, pycolmap sees by itself that they are cut off
        refuse_cut_off(folder)
    pycolmap = load_pycolmap()
    try:
        model = pycolmap.Reconstruction(str(folder))
        for image in model.images.values():
            image.name  # noqa: B018 (is decoded here)
        if not binary:
            _name_whole(folder / "images.txt", model)
    except UnicodeDecodeError as error:
        raise BadInput(
            f"{folder}: the name of an image is not UTF-8 ({error.object!r}); rename the photograph, also in the model"
        ) from error
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError) as error:
        if "model does not exist" in str(error):
            raise BadInput(
                f"{folder}: a camera model that COLMAP does not know; undistort the photographs with the program that "
                "made it"
            ) from error
        reason = " ".join(str(error).split())
        raise BadInput(f"{folder}: the COLMAP model is damaged: {reason}; write it again or copy it whole") from error
    cameras = sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if binary and (folder / "cameras.bin").stat().st_size < 8 + cameras:
        raise cut_off(folder / "cameras.bin")
    return model


def _name_whole(path: Path, model: Any) -> None:
    """Give images their names with blanks: pycolmap ends names in text files at the first blank.

    A line is IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; the next one has observations, and may be empty.
    """
    with path.open(encoding="utf-8", newline="\n") as file:
        lines = iter(file)
        for line in lines:
            words = line.split(None, 9)
            if not words or words[0].startswith("#"):
                continue
            next(lines, None)
            number = int(words[0])
            if len(words) == 10 and number in model.images:
                name = words[9].rstrip("\r\n").rstrip()
                if model.images[number].name != name:
                    model.image(number).name = name


def _shots(folder: Path, model: Any) -> list[ColmapImage]:
    shots = []
    for _, image in sorted(model.images.items()):
        if not getattr(image, "has_pose", True):
            continue
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        full = np.eye(4)
        full[:3] = pose.matrix()
        if not np.isfinite(full).all():
            reject(BadInput(f"{folder}: the pose of {image.name!r} is not finite; delete the image from the model"))
            continue
        shots.append(ColmapImage(image.name, full, model.cameras[image.camera_id]))
    if not shots:
        raise BadInput(f"{folder}: the model has no image with a pose; run COLMAP's mapper on the photographs")
    return shots


def _photographs(root: Path, data: Data, names: Sequence[str]) -> list[Path | None]:
    """File of every photograph; where one that is missing should be, or None if it is to be skipped."""
    folder = root / (data.images or "images")
    if not folder.is_dir():
        other = next((path.name for path in sorted(root.glob("images_*")) if path.is_dir()), None)
        such = f", such as --images {other}" if other else ""
        text = f"{folder}: no such folder of photographs; put them there, or name theirs with --images{such}"
        reject(BadInput(text))
        return [folder / name for name in names]
    found = find_files(folder, names)
    if missing := [name for name in names if name not in found]:
        used = set(found.values())
        spare = [path for path in sorted(folder.rglob("*")) if path.is_file() and path not in used]
        near = nearest(missing[0], [path.relative_to(folder).as_posix() for path in spare])
        data.lack(folder, missing, len(names), near or "; put them there, or delete them from the model")
    lost = None if data.missing == "skip" and found else folder
    return [found.get(name, lost and lost / name) for name in names]
