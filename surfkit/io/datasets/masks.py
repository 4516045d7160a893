"""Masks beside photographs: what is black, or transparent, is ignored."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from surfkit.core.check import BadInput, few, reject
from surfkit.core.events import Progress, Warned, emit
from surfkit.io.datasets.pixel_interpretation import PixelInterpretation
from surfkit.io.datasets.raw_dataset import RawImage
from surfkit.scene.cache import Cache
from surfkit.scene.photos import open_header, open_picture, photo_size
from surfkit.scene.pixels import has_opacity, opacity_of
from surfkit.scene.scene import Mask, View

MASKS_FOLDER = "masks"
MASK_MARKS = (".mask", "_mask")
"""What may follow the name of a photograph, before the ending."""
MIN_LABELLED_SHARE, MAX_LABEL_VALUES = 0.01, 16
"""Share of the pixels left out that are not black, and number of different values, up to which a mask may be one of
labels."""
MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
READER_THREADS = 4


def find_masks(root: Path, folder: Path | None, shots: Sequence[RawImage]) -> dict[str, Mask]:
    """The mask of each photograph that has one, by name.

    Masks are those that the data set names; `masks/NAME.png` or `masks/STEM.png` with the folders of the photograph or
    without, in any folder called masks; or STEM_mask.png and STEM.mask.png, there or beside the photograph, in capitals
    or not, and with the ending of any picture.

    Whether alpha channels or colours count is decided for all of them together: alone, a cut-out that is opaque
    throughout looks like a mask by its colours, which are black as often as not.

    Args:
        root: The data set.
        folder: Of the masks, relative to the data set; every folder called masks if None.
        shots: All photographs of the data set, not a part of them.

    Raises:
        BadInput: The folder or a mask that the data set names is not there.
    """
    known, beside = _index(_folders(root, folder)), _beside(shots)
    found = {}
    for shot in shots:
        if shot.mask is not None and not shot.mask.is_file():
            reject(BadInput(f"{shot.mask}: no such mask, which the data set names for {shot.name!r}"))
        elif mask := shot.mask or _of(shot, known, beside):
            found[shot.name] = mask
    cut_out, clear = _cut_out(list(dict.fromkeys(found.values())))
    masks = {name: Mask(path, path in cut_out) for name, path in found.items()}
    if by_colours := [name for name, mask in masks.items() if not mask.alpha]:
        emit(Warned(f"what is black in their masks is ignored in {len(by_colours)} of {len(shots)} photographs"))
    elif not found and known:
        emit(Warned(f"none of the {len(known)} masks has the name of a photograph; call them {MASKS_FOLDER}/NAME.png"))
    if cut_out:
        count = f"{len(found) - len(by_colours)} of {len(shots)} photographs"
        emit(
            Warned(
                f"what is transparent in their masks is ignored in {count}: these masks have an alpha channel, {clear} "
                "has transparent pixels, and colours do not count in any of them"
            )
        )
    return masks


def with_opacity(masks: Mapping[str, Mask], shots: Sequence[RawImage], decided: PixelInterpretation) -> dict[str, Mask]:
    """Masks by name, with photographs whose own opacity is the mask; a mask that is there already goes before it."""
    both, own = [], {}
    for shot in shots:
        if decided.pixels[shot.name].alpha == "mask":
            own[shot.name] = Mask(shot.path, alpha=True)
            both += [shot.name] if shot.name in masks else []
    if both:
        text = f"{len(both)} photographs have a mask and an opacity, {few(both)}"
        emit(Warned(f"{text}: the mask alone says what is ignored"))
    return {**own, **masks}


def read_mask(path: Path, size: tuple[int, int], alpha: bool = False) -> Tensor:
    """(H, W) bool of a mask at another size: False where it is black, and the pixel is to be ignored.

    Black is the lower half of the values, 0 to 255 or 65535; in a mask of two values only, it is the lower one. Of
    colours, in whatever mode they are stored, the brightest channel counts.

    Args:
        path: Any picture.
        size: Width and height wanted; every pixel takes the nearest one of the mask.
        alpha: Whether its alpha channel counts, and not its colours: what is opaque by half is kept.

    Raises:
        BadInput: The file is damaged.
    """

    def decode(image: Image.Image) -> np.ndarray:
        if alpha and has_opacity(image):
            return np.array(Image.fromarray(opacity_of(image)).resize(size, Image.Resampling.NEAREST)) > 127
        wanted = {"1": "L", "LA": "L", "P": "RGB", "PA": "RGB", "RGBA": "RGB", "CMYK": "RGB"}
        values = np.asarray(image.convert(wanted[image.mode]) if image.mode in wanted else image)
        values = values.max(-1) if values.ndim == 3 else values
        kept = _is_kept(values)
        if _has_labels(values, kept):
            _tell_labels(path)
        return np.array(Image.fromarray(kept).resize(size, Image.Resampling.NEAREST))

    return torch.from_numpy(open_picture(path, decode))


def _is_kept(values: np.ndarray) -> np.ndarray:
    """(H, W) bool of the values of a mask, see `read_mask`."""
    least, most = values.min(), values.max()
    if least < most and ((values == least) | (values == most)).all():
        return values == most
    return values > (0 if most <= 1 else 127 if most <= 255 else 32767)


def _has_labels(values: np.ndarray, kept: np.ndarray) -> bool:
    """Whether much of what the values (H, W) of a mask leave out is not their least one, as in a picture of labels; not
    so soft edges and the noise of JPEG, which have many values."""
    below = values[~kept]
    return (
        bool(below.size)
        and (below > below.min()).mean() > MIN_LABELLED_SHARE
        and len(np.unique(values)) <= MAX_LABEL_VALUES
    )


@lru_cache(maxsize=256)
def _labelled(folder: Path) -> list[Path]:
    """The masks of a folder that were told to have labels: the first one."""
    return []


def _tell_labels(path: Path) -> None:
    if not (told := _labelled(path.parent)):
        told.append(path)
        emit(
            Warned(
                f"{path}: the mask has more values than two, and those up to half of the full range are ignored as "
                "black; where it has labels, write 0 for what is to be ignored and 255 for the rest"
            )
        )


def mask_cache(views: Sequence[View], budget_bytes: int | None = None) -> Cache[Tensor | None] | None:
    """The masks of views by position, (H, W) bool or None; None if no view has one.

    Once all of them have been read, a line names those that keep nothing of their photographs.
    """
    if not any(view.mask for view in views):
        return None
    looked_at = _Emptied(views)

    def read(at: int) -> Tensor | None:
        mask = view_mask(views[at])
        if mask is not None:
            looked_at.note(at, bool(mask.any()))
        return mask

    return Cache(read, mask_sizes(views), budget_bytes)


def mask_sizes(views: Sequence[View]) -> list[int]:
    """Bytes of the mask of each view."""
    return [view.camera.width * view.camera.height if view.mask else 0 for view in views]


def view_mask(view: View) -> Tensor | None:
    """(H, W) bool of the mask of a view, if it has one, at the size of its camera."""
    size = view.camera.width, view.camera.height
    return None if view.mask is None else read_mask(view.mask.path, size, view.mask.alpha)


def check_mask(path: Path, size: tuple[int, int]) -> None:
    """BadInput for a mask that is damaged, or not of the shape of a photograph of a width and height."""
    width, height = photo_size(path)
    if abs(width * size[1] - height * size[0]) > 1.5 * max(width, height, *size):
        raise BadInput(f"{path}: {width} x {height} px is not the shape of its photograph; make the mask anew")


def empty_masks(names: Sequence[str]) -> str:
    """What to say of masks that keep nothing, by the names of their photographs."""
    count = "1 mask keeps" if len(names) == 1 else f"{len(names)} masks keep"
    return f"{count} nothing of the photograph, {few(names)}; correct or delete {'it' if len(names) == 1 else 'them'}"


class _Emptied:
    """Says of masks, once all have been read, which keep nothing of their photographs: they are decoded once."""

    def __init__(self, views: Sequence[View]) -> None:
        self._views, self._lock = views, threading.Lock()
        self._empty: list[int] = []
        self._left = {at for at, view in enumerate(views) if view.mask is not None and not view.mask.is_part}

    def note(self, at: int, keeps: bool) -> None:
        """The mask of a position was read, and keeps something or not."""
        with self._lock:
            if at not in self._left:
                return
            self._left.remove(at)
            self._empty += [] if keeps else [at]
            done = not self._left
        if done and self._empty:
            views = [self._views[at] for at in sorted(self._empty)]
            _tell(empty_masks([view.name for view in views]), tuple(view.mask for view in views))


@lru_cache(maxsize=256)
def _tell(text: str, masks: tuple[Mask, ...]) -> None:
    """Say something of masks once, however many stages read them."""
    emit(Warned(text))


def _cut_out(paths: Sequence[Path]) -> tuple[set[Path], Path | None]:
    """Masks of which the alpha channel counts, and one of them that has transparent pixels.

    They are all that have such a channel, if one has transparent pixels. Only these are decoded, up to that one.
    """
    with ThreadPoolExecutor(READER_THREADS) as pool:
        having = [path for path, has in zip(paths, pool.map(_has_alpha, paths), strict=True) if has]
        for at in range(0, len(having), READER_THREADS):
            some = having[at : at + READER_THREADS]
            if clear := [path for path, is_clear in zip(some, pool.map(_is_clear, some), strict=True) if is_clear]:
                return set(having), clear[0]
            emit(Progress("looking at masks", at + len(some), len(having)))
    return set(), None


def _has_alpha(path: Path) -> bool:
    """Whether a mask has an alpha channel."""
    try:
        return open_header(path, has_opacity)
    except BadInput:  # told when the mask is looked at
        return False


def _is_clear(path: Path) -> bool:
    """Whether a mask with an alpha channel has transparent pixels."""
    try:
        stat = path.stat()
        return _decoded_is_clear(path, stat.st_size, stat.st_mtime_ns)
    except (BadInput, OSError):  # told when the mask is looked at
        return False


@lru_cache(maxsize=1 << 17)
def _decoded_is_clear(path: Path, size: int, time_ns: int) -> bool:
    """The same of a file of a size and time: a command may read its data set several times."""
    return open_picture(path, lambda image: int(opacity_of(image).min(initial=255)) < 255)


def _folders(root: Path, folder: Path | None) -> list[Path]:
    if folder is None:
        return sorted(path for path in root.rglob(MASKS_FOLDER) if path.is_dir())
    if not (root / folder).is_dir():
        raise BadInput(f"--masks {root / folder}: no such folder of masks")
    return [root / folder]


def _index(folders: Sequence[Path]) -> dict[str, set[Path]]:
    """Masks by the names that they may be meant for."""
    known: dict[str, set[Path]] = {}
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.suffix.lower() in MASK_SUFFIXES and path.is_file():
                name = PurePosixPath(path.relative_to(folder).as_posix())
                meant = str(name.with_suffix("")).lower()
                for mark in MASK_MARKS:
                    meant = meant.removesuffix(mark)
                for key in (meant, PurePosixPath(meant).name):
                    known.setdefault(key, set()).add(path)
    return known


def _beside(shots: Sequence[RawImage]) -> dict[Path, Path]:
    """Masks in the folders of photographs, by the path without ending and mark, the name in small letters."""
    photos = {shot.path for shot in shots}
    found: dict[Path, Path] = {}
    for folder in sorted({path.parent for path in photos}):
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path not in photos and path.suffix.lower() in MASK_SUFFIXES and (name := masked_name(path.name)):
                found.setdefault(path.with_name(name), path)
    return found


def masked_name(name: str) -> str:
    """What a mask is the mask of, by its name, in small letters: "a" or "a.jpg"; "" for what is not called as masks
    are. OpenDroneMap's are called a_MASK.JPG."""
    stem = PurePosixPath(name).stem.lower()
    return next((stem.removesuffix(mark) for mark in MASK_MARKS if stem.endswith(mark)), "")


def _of(shot: RawImage, known: dict[str, set[Path]], beside: dict[Path, Path]) -> Path | None:
    """The mask of a photograph, by the first of its names that belongs to one mask only."""
    for name in _names(shot):
        if len(masks := known.get(name.lower(), ())) == 1:
            return next(iter(masks))
    own = (shot.path.with_suffix("").name, shot.path.name)
    return next((mask for name in own if (mask := beside.get(shot.path.with_name(name.lower())))), None)


def _names(shot: RawImage) -> Iterator[str]:
    """What a mask may be called without its ending: the whole path first, the mere stem last."""
    path = PurePosixPath(shot.name.replace("\\", "/"))
    yield str(path)
    yield str(path.with_suffix(""))
    yield path.name
    yield path.stem
