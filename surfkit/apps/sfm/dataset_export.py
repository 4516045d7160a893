"""The data set: photographs as pinhole cameras would have taken them, and COLMAP models of these cameras."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from surfkit.apps.sfm.engine import load_engine
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.mapping import read_model
from surfkit.apps.sfm.row_motion import RowMotion
from surfkit.apps.sfm.sources import Sources
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.events import Progress, emit
from surfkit.core.files import delete_with_folders, replacing, replacing_folder
from surfkit.io.datasets.georeference_file import GEOREFERENCE_FILE, Georeference
from surfkit.scene.photo_names import safe_path
from surfkit.scene.photos import read_photo
from surfkit.scene.pixels import Pixels

CACHE_VERSION = "1"
"""Changes when the same photograph would come out otherwise."""
JPEG_QUALITY = 95
"""Of JPEG files."""
MAX_PHOTO_THREADS = 8
"""Each holds a photograph at its full size three times."""
UNDISTORTED_RECORD = "undistorted.json"
SAME_CAMERA, SAME_POINT, SAME_PX = 1e-7, 1e-6, 1e-4
"""Models that differ by less are one: positions as shares of the spread of the cameras, rotations in radians, and focal
lengths in pixels. That is a hundredth of a pixel; solvers that add up in another order differ by a hundredth of it."""


@dataclass(frozen=True)
class UndistortedImage:
    """What an undistorted photograph adds to its model.

    Attributes:
        pixels: (K, 2) where its features with a point lie in it.
        colours: (K, 3) uint8 there.
    """

    pixels: np.ndarray
    colours: np.ndarray


def deliver(
    models: Sequence[tuple[Any, Georeference | None]],
    photos: Mapping[str, Photo],
    sources: Sources,
    scene: Path,
    work: Path,
    motions: Mapping[str, RowMotion] | None = None,
) -> None:
    """Write SCENE/images and SCENE/sparse/0, 1, ...; photographs that are there already are not written again.

    Args:
        models: pycolmap.Reconstruction, and where it lies on Earth; the largest first.
        photos: By name.
        sources: Where the photographs are.
        scene: The data set.
        work: Folder for the record of what was written.
        motions: Of cameras during the readout of photographs, by their names; they are taken out.
    """
    motions = motions or {}
    try:
        before = read_json(work / UNDISTORTED_RECORD, dict[str, str])
    except BadInput:
        before = {}
    lenses = [(image.name, model.cameras[image.camera_id]) for model, _ in models for image in _images(model)]
    wanted = {file_name(name): _key(photos[name], camera, motions.get(name)) for name, camera in lenses}
    if any(before.get(name) != key for name, key in wanted.items()):
        before = {name: key if wanted.get(name, key) == key else "" for name, key in before.items()}
        write_json(work / UNDISTORTED_RECORD, before)  # what a kill leaves half replaced counts as neither
        shutil.rmtree(scene / "sparse", ignore_errors=True)  # a model of other photographs would not be noticed
    total, done = sum(model.num_reg_images() for model, _ in models), 0
    kept: dict[str, str] = {}
    pinholes = []
    for model, _ in models:
        images = _images(model)
        cameras = {image.camera_id: _pinhole(model.cameras[image.camera_id]) for image in images}
        sights = {}
        with ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_PHOTO_THREADS)) as pool:

            def undistort(image: Any, model: Any = model) -> UndistortedImage:
                motion = motions.get(image.name)
                key = _key(photos[image.name], model.cameras[image.camera_id], motion)
                name = file_name(image.name)
                source = sources.path(image.name)
                reading = photos[image.name].reading
                made = _write(source, reading, scene / "images" / name, model, image, motion, before.get(name) == key)
                kept[name] = key
                return made

            waiting = [(image, pool.submit(undistort, image)) for image in images]
            try:
                for image, future in waiting:
                    sights[image.image_id] = future.result()
                    done += 1
                    emit(Progress("undistorting photographs", done, total))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
            finally:
                write_json(work / UNDISTORTED_RECORD, before | kept)
        pinholes.append(_rebuilt(model, images, cameras, sights))
    for name in set(before) - set(kept):
        if str(safe_path(name)) == name:  # the record may be another's
            delete_with_folders(scene / "images" / name, scene)
    write_json(work / UNDISTORTED_RECORD, kept)
    with replacing_folder(scene / "sparse") as folder:
        for number, (pinhole, (_, placed)) in enumerate(zip(pinholes, models, strict=True)):
            (folder / str(number)).mkdir()
            there = scene / "sparse" / str(number)
            if _is_same(there, pinhole):  # to the last bit, so that runs on it can still be used
                for path in there.glob("*.bin"):
                    shutil.copyfile(path, folder / str(number) / path.name)
            else:
                pinhole.write_binary(folder / str(number))
            if placed is not None:
                write_json(folder / str(number) / GEOREFERENCE_FILE, placed)


def _is_same(folder: Path, new: Any) -> bool:
    """Whether the model in a folder is a new one, but for the last digits."""
    if not (folder / "images.bin").is_file():
        return False
    try:
        old = read_model(folder)
    except BadInput:
        return False
    if [image.name for image in _images(old)] != [image.name for image in _images(new)]:
        return False
    if old.point3D_ids() != new.point3D_ids() or old.compute_num_observations() != new.compute_num_observations():
        return False

    def near(values: Callable[[Any], list[Any]], most: float) -> bool:
        one, other = (np.array(values(model), np.float64) for model in (old, new))
        return one.shape == other.shape and bool(np.abs(one - other).max(initial=0) <= most)

    spread = float(np.ptp([image.projection_center() for image in _images(new)], axis=0).max())
    return (
        near(lambda model: [[c.width, c.height, *c.params] for _, c in sorted(model.cameras.items())], SAME_PX)
        and near(lambda model: [image.cam_from_world().rotation.matrix() for image in _images(model)], SAME_CAMERA)
        and near(lambda model: [image.projection_center() for image in _images(model)], SAME_CAMERA * spread)
        and near(lambda model: [point.xyz for _, point in sorted(model.points3D.items())], SAME_POINT * spread)
    )


def _images(model: Any) -> list[Any]:
    """The images with a pose, by name."""
    return sorted((model.image(number) for number in model.reg_image_ids()), key=lambda image: image.name)


def file_name(name: str) -> str:
    """The name of an undistorted photograph: JPEG stays JPEG, all else becomes PNG."""
    return name if Path(name).suffix.lower() in (".jpg", ".jpeg", ".png") else f"{name}.png"


def _key(photo: Photo, camera: Any, motion: RowMotion | None) -> str:
    said = f"{CACHE_VERSION} {JPEG_QUALITY} {photo.digest} {camera.model.name} {np.round(camera.params, 7).tolist()}"
    said += f" {motion}" if motion is not None else ""
    return hashlib.sha256(said.encode()).hexdigest()[:24]


def _pinhole(camera: Any) -> Any:
    engine = load_engine()
    try:
        return engine.undistort_camera(engine.UndistortCameraOptions(), camera)
    except (RuntimeError, ValueError) as error:
        said = " ".join(str(error).split())
        raise BadInput(f"the lens that was found cannot be undistorted: {said}; choose another with --lens") from error


def undistorted(pixels: np.ndarray, camera: Any, motion: RowMotion | None) -> np.ndarray:
    """(H, W, 3) uint8 of the pinhole camera of a lens, of a photograph (h, w, 3) uint8, whose rows are seen at once."""
    if motion is not None:
        return motion.straightened(pixels, camera, _pinhole(camera))
    engine = load_engine()
    bitmap = engine.Bitmap.from_array(np.ascontiguousarray(pixels))
    return np.array(engine.undistort_image(engine.UndistortCameraOptions(), bitmap, camera)[0].to_array())


def _write(
    source: Path, reading: Pixels, target: Path, model: Any, image: Any, motion: RowMotion | None, there: bool
) -> UndistortedImage:
    """Write an undistorted photograph unless it is there, and look at it where its features are."""
    camera = model.cameras[image.camera_id]
    bent = np.array([spot.xy for spot in image.get_observation_points2D()], np.float64).reshape(-1, 2)
    pinhole = _pinhole(camera)
    if not (there and target.is_file()):
        pixels = read_photo(source, (camera.width, camera.height), pixels=reading).permute(1, 2, 0).numpy()
        straight = undistorted(pixels, camera, motion)
        with replacing(target) as file:
            if target.suffix.lower() == ".png":
                Image.fromarray(straight).save(file, "PNG", compress_level=1)
            else:
                Image.fromarray(straight).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    straight = read_photo(target, (pinhole.width, pinhole.height)).permute(1, 2, 0).numpy()
    rays = np.asarray(camera.cam_from_img(bent)).reshape(-1, 2)
    spots = np.asarray(pinhole.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))).reshape(-1, 2)
    column = np.floor(np.nan_to_num(spots[:, 0])).clip(0, pinhole.width - 1).astype(int)
    row = np.floor(np.nan_to_num(spots[:, 1])).clip(0, pinhole.height - 1).astype(int)
    return UndistortedImage(spots, straight[row, column])


def _rebuilt(
    model: Any, images: Sequence[Any], cameras: Mapping[int, Any], sights: Mapping[int, UndistortedImage]
) -> Any:
    """The model with pinhole cameras, with features that have a point only, and with colours."""
    engine = load_engine()
    new = engine.Reconstruction()
    for number, pinhole in sorted(cameras.items()):
        pinhole.camera_id = number
        new.add_camera_with_trivial_rig(pinhole)
    colours = {number: np.zeros(4) for number in model.point3D_ids()}
    tracks = {number: engine.Track() for number in model.point3D_ids()}
    for number, image in enumerate(images, 1):
        sight = sights[image.image_id]
        seen = [spot.point3D_id for spot in image.get_observation_points2D()]
        fresh = engine.Image(
            name=file_name(image.name), keypoints=sight.pixels, camera_id=image.camera_id, image_id=number
        )
        new.add_image_with_trivial_frame(fresh, image.cam_from_world())
        for at, (point, colour) in enumerate(zip(seen, sight.colours.tolist(), strict=True)):
            colours[point] += (*colour, 1)
            tracks[point].add_element(number, at)
    for number, point in sorted(model.points3D.items()):
        mean = (colours[number][:3] / max(colours[number][3], 1)).round().astype(np.uint8)
        new.add_point3D(point.xyz, tracks[number], mean)
    new.update_point_3d_errors()
    return new
