"""Photographs of distorted cameras as a pinhole camera would have taken them, made once and kept on disk."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample

from surfkit.core.check import BadInput
from surfkit.core.files import replacing
from surfkit.io.datasets.masks import read_mask
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.scene.decoded_photos import digest, place
from surfkit.scene.photos import read_photo
from surfkit.scene.pixels import DEFAULT_PIXELS, Pixels
from surfkit.scene.scene import Lens, Mask

UNDISTORTED_FOLDER = "undistorted"
CACHE_VERSION = "1"
"""Changes when the same photograph would come out otherwise: what is on disk is then made again."""
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")
MIN_FOCAL_PX = 1e-6
"""Shorter focal lengths are a mistake."""
PANORAMA_MODEL = "EQUIRECTANGULAR"
"""COLMAP's model of a panorama."""
POLYNOMIAL = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that are pinholes when all their coefficients are 0."""


@dataclass(frozen=True)
class DistortedPhoto:
    """A photograph and the camera that took it.

    Attributes:
        path: On disk.
        mask: Its mask, if it has one.
        camera: pycolmap.Camera.
        size: Width and height to use it at.
        white: Whether its transparent pixels lie over white, or over black.
        pixels: What the values of the file mean.
    """

    path: Path
    mask: Mask | None
    camera: Any
    size: tuple[int, int]
    white: bool = False
    pixels: Pixels = DEFAULT_PIXELS


def is_pinhole(camera: Any) -> bool:
    """Whether a camera shows straight lines as straight."""
    name = camera.model.name
    extra = [camera.params[i] for i in camera.extra_params_idxs()]
    return name in PINHOLES or (name in POLYNOMIAL and not any(extra))


def is_panorama(camera: Any) -> bool:
    """Whether a camera is that of an equirectangular panorama."""
    return bool(camera.model.name == PANORAMA_MODEL)


def check_camera(camera: Any, name: str) -> None:
    """BadInput for a camera that cannot be used; `name` is one of its photographs."""
    where = f"camera {camera.camera_id} of {name}"
    values = [*camera.params, camera.width, camera.height]
    if not (np.isfinite(values).all() and camera.width > 0 and camera.height > 0):
        raise BadInput(f"{where} has size {camera.width} x {camera.height} and parameters {list(camera.params)}")
    if not all(camera.params[i] > MIN_FOCAL_PX for i in camera.focal_length_idxs()):
        raise BadInput(f"{where} has size {camera.width} x {camera.height} and parameters {list(camera.params)}")


def undistort(picture: DistortedPhoto, root: Path, keep: Path | None = None) -> DistortedPhoto:
    """The picture of a pinhole camera, from the cache of the data set or made now.

    Args:
        picture: Of any perspective or fisheye camera.
        root: The data set, in which the cache is kept; where that cannot be written, the user's own cache.
        keep: Folder of the cache, where it is to be another one.

    Raises:
        BadInput: The photograph is damaged, or its camera has no pinhole equivalent.
    """
    lens = lens_of(picture.camera, picture.size)
    camera, grid, inside = warp(lens)
    path = (keep or cache_folder(root)) / _cached(picture, lens, root)
    mask = path.with_name(f"{path.stem}-mask.png") if picture.mask is not None or not inside.all() else None
    if not path.exists():
        if mask is not None:
            save_mask(mask, _keep(picture, grid, inside))
        values = resampled(read_layers(picture, picture.size), grid)
        save_picture(path, values * inside)  # last: with it, the mask is there too
    size = camera.width, camera.height
    kept = None if mask is None else Mask(mask)
    return replace(picture, path=path, mask=kept, camera=camera, size=size, pixels=DEFAULT_PIXELS)


def read_layers(picture: DistortedPhoto, size: tuple[int, int]) -> Tensor:
    """(3, H, W) uint8 of a picture at a width and height; (4, H, W) where its own opacity is its mask.

    The colours of transparent pixels are none then, and must not spread: they are 0, and the fourth layer is 1 where
    there are colours.
    """
    photo = read_photo(picture.path, size, picture.white, picture.pixels)
    if not _is_own_mask(picture):
        return photo
    shown = read_mask(picture.path, size, alpha=True).to(torch.uint8)[None]
    return torch.cat([photo * shown, shown])


def resampled(layers: Tensor, grid: Tensor) -> Tensor:
    """(3, h, w) float32 colours of `read_layers` at (1, h, w, 2) places as `grid_sample` has them."""
    each = [grid_sample(one[None, None].float(), grid, "bicubic", "border", align_corners=False)[0] for one in layers]
    values = torch.cat(each)  # one by one, as floats take four times the memory
    return values[:3] / values[3:].clamp(min=0.1) if len(values) > 3 else values


def pinhole_of(picture: DistortedPhoto) -> DistortedPhoto:
    """The picture that `undistort` gives, without its pixels: its paths are those of the distorted photograph."""
    camera, _, _ = warp(lens_of(picture.camera, picture.size))
    return replace(picture, camera=camera, size=(camera.width, camera.height))


def lens_of(camera: Any, size: tuple[int, int]) -> Lens:
    """A pycolmap camera as plain values, at the width and height it is used at."""
    scaled = load_pycolmap().Camera(
        model=camera.model.name, width=camera.width, height=camera.height, params=list(camera.params)
    )
    scaled.rescale(*size)
    return Lens(camera.model.name, tuple(scaled.params), *size)


@lru_cache(maxsize=8)
def warp(lens: Lens) -> tuple[Any, Tensor, Tensor]:
    """The pinhole camera for a lens, and where its pixels lie in the photograph.

    Returns:
        The camera; (1, h, w, 2) places as `grid_sample` has them; (h, w) bool, whether a pixel lies in the photograph.

    Raises:
        BadInput: The camera has no pinhole equivalent.
    """
    source = load_pycolmap().Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    try:
        camera = load_pycolmap().undistort_camera(load_pycolmap().UndistortCameraOptions(), source)
    except (ValueError, RuntimeError) as error:
        raise BadInput(f"a {lens.model} camera cannot be undistorted: {' '.join(str(error).split())}") from error
    x = (np.arange(camera.width) + 0.5 - camera.principal_point_x) / camera.focal_length_x
    y = (np.arange(camera.height) + 0.5 - camera.principal_point_y) / camera.focal_length_y
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1).reshape(-1, 3)
    share = np.asarray(source.img_from_cam(rays)) / (lens.width, lens.height)
    inside = (np.isfinite(share) & (share >= 0) & (share <= 1)).all(1)
    grid = np.nan_to_num(share * 2 - 1, nan=-2).clip(-2, 2).astype(np.float32)  # beyond 1 is outside
    shape = (camera.height, camera.width)
    return camera, torch.from_numpy(grid).reshape(1, *shape, 2), torch.from_numpy(inside).reshape(shape)


def _keep(picture: DistortedPhoto, grid: Tensor, inside: Tensor) -> Tensor:
    """(h, w) bool: pixels that the photograph shows and its mask keeps."""
    if picture.mask is None:
        return inside
    mask = read_mask(picture.mask.path, picture.size, picture.mask.alpha).float()[None, None]
    return inside & (grid_sample(mask, grid, "nearest", "border", align_corners=False)[0, 0] > 0.5)


def _is_own_mask(picture: DistortedPhoto) -> bool:
    """Whether the opacity of a photograph is its mask."""
    return picture.mask is not None and picture.mask.path == picture.path


def _cached(picture: DistortedPhoto, lens: Lens, root: Path) -> str:
    """The name of the undistorted picture, which depends on all that it was made from; as earlier versions spelt it."""
    paths = [picture.path] if picture.mask is None else [picture.path, picture.mask.path]
    values = "" if picture.pixels == DEFAULT_PIXELS else f" {picture.pixels}"
    values += " alpha" if picture.mask is not None and picture.mask.alpha and not _is_own_mask(picture) else ""
    return f"{picture.path.stem}-{digest(root, f'{CACHE_VERSION} _{lens} {picture.white}{values}', paths)}.png"


def cache_folder(root: Path) -> Path:
    """Where the undistorted photographs of a data set are kept."""
    return place(root, UNDISTORTED_FOLDER)


def save_picture(path: Path, values: Tensor) -> None:
    """A (3, H, W) picture of floats as PNG; whole or not there."""
    pixels = values.round().clamp(0, 255).to(torch.uint8)
    with replacing(path) as file:
        Image.fromarray(pixels.permute(1, 2, 0).numpy()).save(file, "PNG", compress_level=1)


def save_mask(path: Path, kept: Tensor) -> None:
    """(H, W) bool as a picture that is black where it is False."""
    save_picture(path, kept.float().mul(255)[None].expand(3, -1, -1))
