"""Masks beside photographs: black pixels are ignored."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from surfkit.core.check import BadInput, few, reject
from surfkit.core.events import Warned, emit
from surfkit.readers.capture import Shot
from surfkit.readers.pixels import Decided
from surfkit.scene.cache import Cache
from surfkit.scene.photos import open_header, open_picture, photo_size
from surfkit.scene.pixels import has_opacity, opacity_of
from surfkit.scene.scene import View

FOLDER = "masks"
MARKS = (".mask", "_mask")
"""What may follow the name of a photograph, before the ending."""
ENDS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


def find_masks(root: Path, folder: Path | None, shots: Sequence[Shot]) -> dict[str, Path]:
    """The mask of each photograph that has one, by name.

    Masks are those that the data set names; `masks/NAME.png` or `masks/STEM.png` with the folders of the photograph or
    without, in any folder called masks; or STEM_mask.png and STEM.mask.png, there or beside the photograph.

    Args:
        root: The data set.
        folder: Of the masks, relative to the data set; every folder called masks if None.
        shots: The photographs.

    Raises:
        BadInput: The folder or a mask that the data set names is not there.
    """
    known = _index(_folders(root, folder))
    found = {}
    for shot in shots:
        if shot.mask is not None and not shot.mask.is_file():
            reject(BadInput(f"{shot.mask}: no such mask, which the data set names for {shot.name!r}"))
        elif mask := shot.mask or _of(shot, known):
            found[shot.name] = mask
    if found:
        emit(Warned(f"what is black in their masks is ignored in {len(found)} of {len(shots)} photographs"))
        if clear := [name for name, path in found.items() if _may_be_clear(path)]:
            emit(
                Warned(
                    f"{len(clear)} masks have an alpha channel, that of {clear[0]} for one: where some of it is "
                    "transparent, what is opaque is kept, and its colours do not count"
                )
            )
    elif known:
        emit(Warned(f"none of the {len(known)} masks has the name of a photograph; call them {FOLDER}/NAME.png"))
    return found


def with_opacity(masks: Mapping[str, Path], shots: Sequence[Shot], decided: Decided) -> dict[str, Path]:
    """Masks by name, with photographs whose own opacity is the mask; a mask that is there already goes before it."""
    both, own = [], {}
    for shot in shots:
        if decided.pixels[shot.name].alpha == "mask":
            own[shot.name] = shot.path
            both += [shot.name] if shot.name in masks else []
    if both:
        text = f"{len(both)} photographs have a mask and an opacity, {few(both)}"
        emit(Warned(f"{text}: the mask alone says what is ignored"))
    return {**own, **masks}


def read_mask(path: Path, size: tuple[int, int], photo: bool = False) -> Tensor:
    """(H, W) bool of a mask at another size: False where it is black, and the pixel is to be ignored.

    Black is the lower half of the values; in a mask of 0 and 1 it is 0. Of a mask of which pixels are transparent, what
    is opaque by half is kept, whatever colour it has.

    Args:
        path: Any picture.
        size: Width and height wanted; every pixel takes the nearest one of the mask.
        photo: Whether it is the photograph itself, of which the opacity alone counts.

    Raises:
        BadInput: The file is damaged.
    """

    def decode(image: Image.Image) -> np.ndarray:
        if has_opacity(image):
            clear = opacity_of(image)
            if photo or clear.min(initial=255) < 255:
                return np.asarray(Image.fromarray(clear).resize(size, Image.Resampling.NEAREST)) > 127
        if photo:
            return np.ones((size[1], size[0]), bool)
        plain = image.convert("L") if image.mode in ("1", "P", "PA", "RGBA", "LA", "CMYK") else image
        values = np.asarray(plain.resize(size, Image.Resampling.NEAREST))
        return values.max(-1) if values.ndim == 3 else values

    values = open_picture(path, decode)
    if values.dtype == bool:
        return torch.from_numpy(values)
    most = int(values.max(initial=0))
    half = 0 if most <= 1 else 127 if most <= 255 else 32767
    return torch.from_numpy(values > half)


def mask_cache(views: Sequence[View], budget_bytes: int | None = None) -> Cache[Tensor | None] | None:
    """The masks of views by position, (H, W) bool or None; None if no view has one."""
    if not any(view.mask for view in views):
        return None
    return Cache(lambda at: view_mask(views[at]), mask_sizes(views), budget_bytes)


def mask_sizes(views: Sequence[View]) -> list[int]:
    """Bytes of the mask of each view."""
    return [view.camera.width * view.camera.height if view.mask else 0 for view in views]


def view_mask(view: View) -> Tensor | None:
    """(H, W) bool of the mask of a view, if it has one, at the size of its camera."""
    size = view.camera.width, view.camera.height
    return None if view.mask is None else read_mask(view.mask, size, view.mask == view.path)


def check_mask(path: Path, size: tuple[int, int]) -> None:
    """BadInput for a mask that is damaged, or not of the shape of a photograph of a width and height."""
    width, height = photo_size(path)
    if abs(width * size[1] - height * size[0]) > 1.5 * max(width, height, *size):
        raise BadInput(f"{path}: {width} x {height} px is not the shape of its photograph; make the mask anew")


def _may_be_clear(path: Path) -> bool:
    """Whether a mask has an alpha channel."""
    try:
        return open_header(path, has_opacity)
    except BadInput:  # told when the mask is looked at
        return False


def _folders(root: Path, folder: Path | None) -> list[Path]:
    if folder is None:
        return sorted(path for path in root.rglob(FOLDER) if path.is_dir())
    if not (root / folder).is_dir():
        raise BadInput(f"--masks {root / folder}: no such folder of masks")
    return [root / folder]


def _index(folders: Sequence[Path]) -> dict[str, set[Path]]:
    """Masks by the names that they may be meant for."""
    known: dict[str, set[Path]] = {}
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.suffix.lower() in ENDS and path.is_file():
                name = PurePosixPath(path.relative_to(folder).as_posix())
                meant = str(name.with_suffix("")).lower()
                for mark in MARKS:
                    meant = meant.removesuffix(mark)
                for key in (meant, PurePosixPath(meant).name):
                    known.setdefault(key, set()).add(path)
    return known


def _of(shot: Shot, known: dict[str, set[Path]]) -> Path | None:
    """The mask of a photograph, by the first of its names that belongs to one mask only."""
    for name in _names(shot):
        if len(masks := known.get(name.lower(), ())) == 1:
            return next(iter(masks))
    stem = shot.path.with_suffix("").name
    beside = (shot.path.with_name(f"{start}{mark}.png") for mark in MARKS for start in (stem, shot.path.name))
    return next((path for path in beside if path.is_file()), None)


def _names(shot: Shot) -> Iterator[str]:
    """What a mask may be called without its ending: the whole path first, the mere stem last."""
    path = PurePosixPath(shot.name.replace("\\", "/"))
    yield str(path)
    yield str(path.with_suffix(""))
    yield path.name
    yield path.stem
