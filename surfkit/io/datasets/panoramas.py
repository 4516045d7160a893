"""Equirectangular panoramas, cut into the views of six pinhole cameras that look along the axes of the panorama.

The middle of a panorama shows what lies ahead (z) of its camera, a quarter of its width to the right what lies to the
right (x), its lower edge what lies below (y): COLMAP, OpenSfM, Metashape and nerfstudio agree on that.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.masks import empty_masks, read_mask
from surfkit.io.datasets.raw_dataset import RawImage, Tracks, camera_of
from surfkit.io.datasets.undistort import (
    PANORAMA_MODEL,
    DistortedPhoto,
    is_panorama,
    read_layers,
    resampled,
    save_mask,
    save_picture,
)
from surfkit.scene.byte_semaphore import ByteSemaphore
from surfkit.scene.decoded_photos import digest, place
from surfkit.scene.pixels import DEFAULT_PIXELS
from surfkit.scene.scene import Mask

PANORAMAS_FOLDER = "panoramas"
CACHE_VERSION = "1"
"""Changes when the same views would come out otherwise: what is on disk is then made again."""
CUBE_FACES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""Right, down and ahead of each view, in the axes of the panorama."""
HALF_ANGLE = math.radians(47.5)
"""Of a view, so that neighbours share a strip 5 degrees wide."""
MARGIN_PX = 4
"""Pixels of the other side that are put beyond each edge, for the interpolation."""
CUT_GATE = ByteSemaphore(1 << 30)
"""Bytes of panoramas that are cut at the same time; one always may be."""
ALIGNMENT_HINT = "align them with COLMAP or OpenSfM, whose models have points, and are read"
"""How to get sparse points of panoramas."""
PANORAMA_PIXEL_BYTES = 12
"""Of a pixel of a panorama that is being cut: its layers, the margins, and one layer as floats."""


def panorama(where: str, size: tuple[int, int]) -> Any:
    """The pycolmap camera of a whole panorama of some width and height, or BadInput that names `where` it is from."""
    return camera_of(where, PANORAMA_MODEL, size, size)


def check_whole(path: Path, size: tuple[int, int]) -> None:
    """BadInput unless a panorama of a width and height goes all around, from pole to pole."""
    if abs(size[0] - 2 * size[1]) > 1:
        raise BadInput(
            f"{path}: {size[0]} x {size[1]} px, a panorama that is not twice as wide as high; fill it up to 360 by 180 "
            "degrees, or cut it into perspective photographs"
        )


def parts_of(shot: RawImage) -> list[RawImage]:
    """The views that a photograph gives, with its path: itself, or the six of a panorama."""
    if not is_panorama(shot.camera):
        return [shot]
    camera, found = _camera(shot.camera.width), []
    for name, axes in zip(_named(shot.name), CUBE_FACES.values(), strict=True):
        pose = shot.pose.copy()
        pose[:3] = np.array(axes, np.float64) @ shot.pose[:3]
        found.append(replace(shot, name=name, pose=pose, camera=camera))
    return found


def view_names(shots: Sequence[RawImage]) -> list[str]:
    """Names of the views that photographs give."""
    return [name for shot in shots for name in (_named(shot.name) if is_panorama(shot.camera) else [shot.name])]


def has_panoramas(names: Iterable[str]) -> bool:
    """Whether all six views of any panorama are among names of views."""
    given = set(names)
    fronts = (name.removesuffix("-front.png") for name in given if name.endswith("-front.png"))
    return any(given.issuperset(_named(f"{stem}.png")) for stem in fronts)


def points_remedy(path: Path, names: Iterable[str]) -> str:
    """How to get sparse points, and which photographs show them, for a data set without.

    Args:
        path: The data set.
        names: Of the views that its photographs give.
    """
    if has_panoramas(names):
        return f"its photographs are panoramas, whose points surfkit does not find: {ALIGNMENT_HINT}"
    return f"`surfkit prepare points {shlex.quote(str(path))}` makes a data set with sparse points"


def view_sizes(data: Data, shot: RawImage, size: tuple[int, int]) -> list[tuple[int, int]]:
    """Width and height of each view that a photograph gives, which has a width and height itself."""
    if not is_panorama(shot.camera):
        return [data.size(*size)]
    side = _side(size[0])
    return [data.size(side, side)] * len(CUBE_FACES)


def size_to_read(data: Data, shot: RawImage, size: tuple[int, int]) -> tuple[int, int]:
    """Width and height at which a photograph is decoded that has a width and height itself.

    A panorama is reduced as much as its views are.
    """
    if not is_panorama(shot.camera):
        return data.size(*size)
    width = round(size[0] * view_sizes(data, shot, size)[0][0] / _side(size[0]))
    return max(width, 4 * MARGIN_PX), max(round(width / 2), 2 * MARGIN_PX)


def cut(
    shot: RawImage, picture: DistortedPhoto, side: int, root: Path, keep: Path | None = None
) -> list[tuple[RawImage, DistortedPhoto]]:
    """The six views of a panorama, from the cache of the data set or made now.

    Args:
        shot: The panorama.
        picture: Its file and mask, and the size to read it at.
        side: Width and height of the views, pixels.
        root: The data set, in which the cache is kept; where that cannot be written, the user's own cache.
        keep: Folder of the cache, where it is to be another one.

    Raises:
        BadInput: The file is damaged.
    """
    mask = picture.mask
    paths = [picture.path] + ([mask.path] if mask else [])
    made_of = f"{CACHE_VERSION} {shot.camera.width} {picture.size} {side} {picture.white} {picture.pixels}"
    made_of += " alpha" if mask and mask.alpha else ""
    key, folder = digest(root, made_of, paths), keep or place(root, PANORAMAS_FOLDER)
    files = {face: folder / f"{picture.path.stem}-{key}-{face}.png" for face in CUBE_FACES}
    masks = {face: path.with_name(f"{path.stem}-mask.png") for face, path in files.items()} if mask else {}
    if lacking := [face for face, path in files.items() if not path.exists()]:
        with CUT_GATE.taking(PANORAMA_PIXEL_BYTES * picture.size[0] * picture.size[1]):
            layers, kept = _with_margins(read_layers(picture, picture.size)), None
            if mask is not None:
                whole = read_mask(mask.path, picture.size, mask.alpha)
                if not whole.any():
                    emit(Warned(empty_masks([shot.name])))
                kept = _with_margins(whole[None])
            for face in lacking:
                grid = _grid(face, shot.camera.width, side, picture.size)
                if kept is not None:
                    save_mask(masks[face], grid_sample(kept[None].float(), grid, "nearest", align_corners=False)[0, 0])
                save_picture(files[face], resampled(layers, grid))  # last: with it, the mask is there too
    return [
        (
            view,
            replace(
                part, path=files[face], mask=Mask(masks[face], is_part=True) if mask else None, pixels=DEFAULT_PIXELS
            ),
        )
        for face, (view, part) in zip(CUBE_FACES, views_of(shot, picture, side), strict=True)
    ]


def views_of(shot: RawImage, picture: DistortedPhoto, side: int) -> list[tuple[RawImage, DistortedPhoto]]:
    """What `cut` gives, without the pixels: the paths are those of the panorama."""
    return [(part, replace(picture, camera=part.camera, size=(side, side))) for part in parts_of(shot)]


def cut_tracks(tracks: Tracks) -> Tracks:
    """Tracks with those of the six views in the place of those of each panorama."""
    seen, cameras = {}, {}
    for name, (rows, pixels) in tracks.seen.items():
        camera = tracks.cameras[name]
        if not is_panorama(camera):
            seen[name], cameras[name] = (rows, pixels), camera
            continue
        rays = _rays(pixels / (camera.width, camera.height))
        view = _camera(camera.width)
        for part, axes in zip(_named(name), CUBE_FACES.values(), strict=True):
            local = rays @ np.array(axes, np.float64).T
            with np.errstate(divide="ignore", invalid="ignore"):
                spots = local[:, :2] / local[:, 2:] * view.focal_length + view.width / 2
            shown = (local[:, 2] > 0) & (spots >= 0).all(1) & (spots <= view.width).all(1)
            seen[part], cameras[part] = (rows[shown], spots[shown]), view
    return replace(tracks, seen=seen, cameras=cameras)


def _named(name: str) -> list[str]:
    """What the views of a panorama are called."""
    stem = name.removesuffix(Path(name).suffix)
    return [f"{stem}-{face}.png" for face in CUBE_FACES]


def _side(width: int) -> int:
    """Width and height of the views of a panorama, so that they have as many pixels in a degree, in their middle."""
    return max(2, 2 * round(width / (2 * math.pi) * math.tan(HALF_ANGLE)))


def _camera(width: int) -> Any:
    """The camera of the views of a panorama, with as many pixels in a degree, in its middle, as that has."""
    size = _side(width)
    lens = [width / (2 * math.pi), size / 2, size / 2]
    return camera_of("views of a panorama", "SIMPLE_PINHOLE", (size, size), lens)


def _rays(shares: np.ndarray) -> np.ndarray:
    """(N, 3) directions of (N, 2) places in a panorama, as shares of its width and height."""
    longitude, latitude = (shares[:, 0] - 0.5) * 2 * math.pi, (shares[:, 1] - 0.5) * math.pi
    across = np.cos(latitude)
    return np.stack([across * np.sin(longitude), np.sin(latitude), across * np.cos(longitude)], 1)


@lru_cache(maxsize=len(CUBE_FACES))
def _grid(face: str, camera_width: int, side: int, size: tuple[int, int]) -> Tensor:
    """(1, side, side, 2): where the pixels of a view lie in a panorama of a width and height, with margins, -1 to 1."""
    camera = _camera(camera_width)
    across = ((np.arange(side) + 0.5) / side - 0.5) * camera.width / camera.focal_length
    local = np.stack([*np.meshgrid(across, across), np.ones((side, side))], -1)
    x, y, z = np.moveaxis(local @ np.array(CUBE_FACES[face], np.float64), -1, 0)
    width, height = size
    u = (np.arctan2(x, z) / (2 * math.pi) + 0.5) * width + MARGIN_PX
    v = (np.arctan2(y, np.hypot(x, z)) / math.pi + 0.5) * height + MARGIN_PX
    grid = np.stack([u / (width + 2 * MARGIN_PX), v / (height + 2 * MARGIN_PX)], -1) * 2 - 1
    return torch.from_numpy(grid.astype(np.float32))[None]


def _with_margins(pixels: Tensor) -> Tensor:
    """A (C, H, W) panorama, with what lies across each edge beyond it; a pole is crossed half a turn away."""
    half = pixels.shape[2] // 2
    above, below = (part.flip(1).roll(half, 2) for part in (pixels[:, :MARGIN_PX], pixels[:, -MARGIN_PX:]))
    tall = torch.cat([above, pixels, below], 1)
    return torch.cat([tall[:, :, -MARGIN_PX:], tall, tall[:, :, :MARGIN_PX]], 2)
