"""A data set of any known layout as a scene."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, reject
from surfkit.core.events import Warned, emit, reading_again
from surfkit.core.registry import components, find, name_of
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.colmap import COLMAP, MODEL_FOLDERS
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_layout import DepthQuery, find_maps
from surfkit.io.datasets.georeference_file import GEOREFERENCE_FILE, Georeference, on_the_map, read_placed
from surfkit.io.datasets.masks import check_mask, find_masks, with_opacity
from surfkit.io.datasets.panoramas import (
    CUBE_FACES,
    PANORAMAS_FOLDER,
    check_whole,
    cut,
    cut_tracks,
    parts_of,
    size_to_read,
    view_names,
    view_sizes,
    views_of,
)
from surfkit.io.datasets.photo_cameras import cameras_of
from surfkit.io.datasets.pixel_interpretation import PixelInterpretation, decide
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.record3d import PACKED_SUFFIX
from surfkit.io.datasets.reduced import reduced
from surfkit.io.datasets.sparse_points import sparse_points
from surfkit.io.datasets.undistort import (
    DistortedPhoto,
    check_camera,
    is_panorama,
    is_pinhole,
    lens_of,
    pinhole_of,
    undistort,
)
from surfkit.scene.camera import Camera
from surfkit.scene.connected_photos import groups_warning, untied_warning
from surfkit.scene.crs import known_axes, refuse_other_unit
from surfkit.scene.decoded_photos import place
from surfkit.scene.observations import Observations, Observations2D
from surfkit.scene.photo_names import PICTURE_SUFFIXES, VIDEO_SUFFIXES, is_video
from surfkit.scene.photos import is_turned, photo_size, refuse_large
from surfkit.scene.scene import Frame, Lens, Mask, Scene, View

NO_NUMBER = 2**32 - 1
"""What pycolmap calls cameras of programs that do not number them."""


def read(data: Data) -> Scene:
    """The scene in a data set, in its local frame; photographs of distorted cameras are undistorted on the way, and
    panoramas are cut into views.

    Raises:
        BadInput: Something is missing, damaged, or of a kind that is not supported; one line says what to do.
    """
    reader = reader_of(data)
    if data.layout is None and len(fitting := _fitting(data.path)) > 1:
        others = ", ".join(name for name, other in fitting.items() if other != reader)
        emit(Warned(f"{data.path}: read as {name_of(reader)}; it could also be read with --layout {others}"))
    capture = read_capture(data, reader)
    untied = capture.untied(data.held_out(capture))
    for text in (groups_warning(capture.groups), untied_warning(untied)):
        if text:
            emit(Warned(text))
    return build_scene(data, capture)


def read_capture(data: Data, reader: Reader) -> RawDataset:
    """What a reader finds in a data set, and in the one that is for tests."""
    if data.model is not None and reader.model_folder(data) is None:
        raise BadInput(f"--model {data.model}: a data set of layout {name_of(reader)} has no such model; leave it out")
    capture = _read_placed(data, reader)
    return capture if data.test_data is None else _with_tests(capture, reader, data)


def _read_placed(data: Data, reader: Reader) -> RawDataset:
    """What a reader finds in a data set, on the map if a file says on which."""
    capture, placed = reader.read(data), _placed(data, reader)
    if placed is not None and capture.crs is not None:
        raise BadInput(
            f"{data.path / GEOREFERENCE_FILE}: the cameras name a system themselves, {capture.crs}; delete this file"
        )
    return capture if placed is None else on_the_map(capture, placed)


def _placed(data: Data, reader: Reader) -> Georeference | None:
    """What the data set says of its place on the map; a model in a folder of its own has that file there."""
    return None if reader.model_folder(data) is not None else read_placed(data.path)


def build_scene(
    data: Data,
    capture: RawDataset,
    keep: Path | None = None,
    only: Set[str] | None = None,
    pixels: bool = True,
) -> Scene:
    """The scene of a capture.

    Args:
        data: The data set, and how to use it.
        capture: What its reader has found in it.
        keep: Folder of the undistorted photographs and of the views of panoramas; by default one that later runs find
            again.
        only: Names of the views to make; all by default.
        pixels: Whether photographs are undistorted and panoramas cut; if not, views have the right cameras and nothing
            is written.
    """
    held_out = data.held_out(capture)
    shots: Sequence[RawImage] = sorted(capture.shots, key=lambda shot: shot.name)
    if twice := next((a for a, b in pairwise(sorted(view_names(shots))) if a == b), None):
        reject(BadInput(f"{data.path}: the photograph {twice!r} is there twice; leave one out"))
    poses = np.stack([shot.pose for shot in shots if shot.name not in held_out])
    frame = _frame(data, capture, poses)
    data, shots = reduced(data, shots)
    decided = decide({shot.name: shot.path for shot in shots}, data.alpha, data.white)
    masks = with_opacity(find_masks(data.path, data.masks, shots), shots, decided)
    wanted = [shot for shot in shots if only is None or not only.isdisjoint(view_names([shot]))]
    views = _views(data, wanted, decided, masks, frame, keep, pixels)
    train = [shot for shot in shots if shot.name not in held_out]
    trained = np.stack([part.pose for shot in train for part in parts_of(shot)])
    scene = Scene(
        name=data.path.resolve().name,
        train=tuple(view for shot, view in views if shot not in held_out),
        held_out=tuple(view for shot, view in views if shot in held_out),
        cloud=sparse_points(data.path, capture, trained, frame),
        frame=frame,
    )
    for line in decided.lines:
        emit(Warned(line))
    if whole := [shot for shot in wanted if is_panorama(shot.camera)]:
        emit(Warned(_cutting(data, whole, frame)))
    return scene


def _cutting(data: Data, whole: Sequence[RawImage], frame: Frame) -> str:
    """What to say of panoramas."""
    query = DepthQuery(data.path, [shot.name for shot in whole], model_folder(data), frame.metres)
    maps = 0
    with suppress(BadInput):  # told where depth maps are used
        maps = len(find_maps(query, data.depth_layout))
    unused = f"; depth maps of {maps} of them are not cut with them, and not used" if maps else ""
    count = "1 panorama is" if len(whole) == 1 else f"{len(whole)} panoramas are"
    return f"{count} cut into {len(CUBE_FACES)} views each, which lie in {place(data.path, PANORAMAS_FOLDER)}{unused}"


def _with_tests(capture: RawDataset, reader: Reader, data: Data) -> RawDataset:
    """The photographs of both data sets, those of the test data held out, under the name of its folder."""
    root = data.test_data
    if root is None or not root.is_dir():
        raise BadInput(f"--test-data {root}: no such folder")
    own = _read_placed(replace(data, path=root, model=None, test_data=None), reader).shots
    tests = [replace(shot, name=f"{root.resolve().name}/{shot.name}") for shot in own]
    return replace(capture, shots=[*capture.shots, *tests], held_out=frozenset(shot.name for shot in tests))


def _frame(data: Data, capture: RawDataset, poses: np.ndarray) -> Frame:
    """The frame of the training cameras, with what the data set or the user knows of its place and unit."""
    frame = Frame.around(poses, capture.xyz)
    shift = capture.shift or frame.shift
    given = data.metres_per_unit
    if given is not None and capture.metres not in (None, given):
        emit(Warned(f"--metres-per-unit {given:g} is used, though {data.path} is in units of {capture.metres:g} m"))
    return replace(frame, metres=_metres(given or capture.metres, capture.crs, frame), crs=capture.crs, shift=shift)


def _metres(stated: float | None, crs: str | None, frame: Frame) -> float | None:
    """Metres per unit as they were stated, or as the coordinate reference system has them; a line tells of both where
    they contradict each other."""
    if crs is None or (axes := known_axes(crs)) is None:
        return stated
    try:
        refuse_other_unit(crs, stated, frame.origin)
    except BadInput as error:
        emit(Warned(str(error)))
    return axes.metres if stated is None else stated


def reader_of(data: Data) -> Reader:
    """The reader for a data set: the one that `layout` names, or the one that recognises the folder."""
    root = data.path
    if is_video(root):
        raise BadInput(f"{root}: a video; {_finds_cameras(root)}")
    if root.suffix.lower() == PACKED_SUFFIX and root.is_file():
        command = f"unzip {shlex.quote(str(root))} -d {shlex.quote(str(root.with_suffix('')))}"
        raise BadInput(f"{root}: a packed scan of Record3D; `{command}` unpacks it; give the folder that this makes")
    if not root.is_dir():
        raise BadInput(f"{root}: {'a file, not a folder' if root.exists() else 'no such folder'}; {_wanted()}")
    if not any(root.iterdir()):
        raise BadInput(f"{root}: the folder is empty; {_wanted()}")
    if data.layout is not None:
        return find(Reader, data.layout)()
    fitting = _fitting(root)
    highest = max((reader.priority for reader in fitting.values()), default=0)
    first = {name: reader for name, reader in fitting.items() if reader.priority == highest}
    if len(first) > 1:
        raise BadInput(f"{root}: could be of layout {' or '.join(first)}; choose one with --layout")
    inner = [] if first else [path for path in sorted(root.iterdir()) if path.is_dir() and _fitting(path)]
    if inner:
        raise BadInput(f"{root}: no data set itself, but the folder {inner[0].name!r} in it is one; give {inner[0]}")
    if not first and (photos := bare_photographs(root)):
        raise BadInput(
            f"{root}: no COLMAP model (cameras, images, points3D as .bin or .txt) in {', '.join(MODEL_FOLDERS)}; "
            f"{_finds_cameras(photos)}"
        )
    return next(iter(first.values()), COLMAP())  # which says what it lacks


def _finds_cameras(photos: Path) -> str:
    command = f"surfkit prepare photos {shlex.quote(str(photos))}"  # to be pasted
    return (
        f"`{command}` finds the cameras of the photographs and writes a data set, as `surfkit train --prepare` does "
        "first"
    )


def bare_photographs(root: Path) -> Path | None:
    """What cameras can be found of, where no reader recognises `root`: a folder that has photographs or videos, its
    images/ or itself, or a video."""
    if is_video(root):
        return root
    if not root.is_dir() or _fitting(root):
        return None
    for folder in (root / "images", root):
        if folder.is_dir() and any(
            path.suffix.lower() in PICTURE_SUFFIXES | VIDEO_SUFFIXES for path in folder.rglob("*")
        ):
            return folder
    return None


def _fitting(root: Path) -> dict[str, Reader]:
    """The readers that recognise a folder, by name."""
    return {name: cls() for name, cls in components(Reader).items() if cls().recognises(root)}


def observations(data: Data, scene: Scene) -> Observations:
    """Which points of the sparse model each photograph shows; none where the layout keeps no observations.

    Args:
        data: The data set.
        scene: That `read` gave for it.
    """
    reader = reader_of(data)
    with reading_again():  # most layouts have cameras and tracks in the same files
        tracks, placed, seen = reader.tracks(data), _placed(data, reader), {}
    if tracks is None:
        return Observations(np.zeros((0, 3)), np.zeros(0), {})
    tracks = cut_tracks(tracks)
    for view in (*scene.train, *scene.held_out):
        if view.name in tracks.seen:
            rows, pixels = tracks.seen[view.name]
            seen[view.name] = Observations2D(rows, _shares(pixels, tracks.cameras[view.name], view.camera))
    xyz = tracks.xyz if placed is None else tracks.xyz + placed.offset
    return Observations(scene.frame.to_local(xyz), tracks.error_px, seen)


def model_folder(data: Data) -> Path:
    """Where the sparse model of a data set lies; the data set itself if its layout has none."""
    return reader_of(data).model_folder(data) or data.path


def _wanted() -> str:
    others = ", ".join(name for name in components(Reader) if name != "colmap")
    return (
        f"a data set is a folder with images/ and a COLMAP model in {', '.join(MODEL_FOLDERS[:-1])} or "
        f"{MODEL_FOLDERS[-1]}, "
        f"or of another layout: {others or 'none is registered'}"
    )


def _views(
    data: Data,
    shots: Sequence[RawImage],
    decided: PixelInterpretation,
    masks: Mapping[str, Mask],
    frame: Frame,
    keep: Path | None,
    pixels: bool,
) -> list[tuple[str, View]]:
    """The photographs at the size to use them at, undistorted, with the name of the one that each view is of."""

    def straight(
        shot: RawImage, size: tuple[int, int], picture: DistortedPhoto
    ) -> list[tuple[RawImage, DistortedPhoto]]:
        if is_panorama(shot.camera):
            side = view_sizes(data, shot, size)[0][0]
            return cut(shot, picture, side, data.path, keep) if pixels else views_of(shot, picture, side)
        if is_pinhole(picture.camera):
            return [(shot, picture)]
        return [(shot, undistort(picture, data.path, keep) if pixels else pinhole_of(picture))]

    for shot in {id(shot.camera): shot for shot in reversed(shots)}.values():
        check_camera(shot.camera, shot.name)
    with ThreadPoolExecutor(4) as pool:
        sizes = list(pool.map(lambda shot: photo_size(shot.path), shots))
        turned = list(pool.map(lambda shot: is_turned(shot.path), shots))
        for shot, size in zip(shots, sizes, strict=True):
            check_size(shot, size)
            refuse_large(shot.path, size, size_to_read(data, shot, size))
            if shot.name in masks:
                check_mask(masks[shot.name].path, size)
        given = [
            DistortedPhoto(
                shot.path,
                masks.get(shot.name),
                shot.camera,
                size_to_read(data, shot, size),
                data.white,
                decided.pixels[shot.name],
            )
            for shot, size in zip(shots, sizes, strict=True)
        ]
        made = list(pool.map(straight, shots, sizes, given))
    if any(turned):
        first = shots[turned.index(True)].name
        emit(
            Warned(
                f"{sum(turned)} of {len(shots)} photographs have an EXIF tag that turns them, {first} for one: it is "
                "ignored, as COLMAP and OpenSfM ignore it, and pixels are taken as stored"
            )
        )
    taken_by = cameras_of(shots)
    lenses = [None if is_pinhole(p.camera) or is_panorama(p.camera) else lens_of(p.camera, p.size) for p in given]
    return [
        (shot.name, _view(part, picture, lens, name, frame))
        for shot, parts, lens, name in zip(shots, made, lenses, taken_by, strict=True)
        for part, picture in parts
    ]


def check_size(shot: RawImage, size: tuple[int, int]) -> None:
    """BadInput unless the photograph is the camera's picture at some size, within a pixel; a panorama must be whole."""
    if is_panorama(shot.camera):
        check_whole(shot.path, size)
    full = (shot.camera.width, shot.camera.height)
    long = 0 if full[0] >= full[1] else 1
    if abs(full[1 - long] * size[long] / full[long] - size[1 - long]) <= 1:
        return
    turned = " (turned by 90 degrees)" if size[0] * full[0] == size[1] * full[1] else ""
    advice = "use the photographs that the model was made from, whole and unturned"
    if turned and is_turned(shot.path):
        advice = (
            "the model was made from photographs turned as EXIF says, so save them like that (mogrify -auto-orient)"
        )
    number = f" {shot.camera.camera_id}" if shot.camera.camera_id < NO_NUMBER else ""
    raise BadInput(
        f"{shot.path}: {size[0]} x {size[1]} px{turned}, but its camera{number} has {full[0]} x {full[1]}; {advice}"
    )


def _view(shot: RawImage, picture: DistortedPhoto, bent: Lens | None, taken_by: str, frame: Frame) -> View:
    lens = picture.camera
    full = Camera(
        world_to_camera=frame.local_pose(shot.pose),
        fx=float(lens.focal_length_x),
        fy=float(lens.focal_length_y),
        cx=float(lens.principal_point_x),
        cy=float(lens.principal_point_y),
        width=int(lens.width),
        height=int(lens.height),
    )
    camera, mask = full.resized(*picture.size), picture.mask
    return View(shot.name, camera, picture.path, mask, picture.white, bent, picture.pixels, taken_by)


def _shares(pixels: np.ndarray, lens: Any, camera: Camera) -> np.ndarray:
    """(K, 2) pixels of a lens as shares of the width and height of the undistorted picture."""
    if is_pinhole(lens):
        return pixels / (lens.width, lens.height)
    rays = np.asarray(lens.cam_from_img(pixels), np.float64).reshape(-1, 2)
    return (rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)) / (camera.width, camera.height)
