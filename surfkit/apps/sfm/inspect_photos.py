"""The photographs of a folder, each looked at once: its size, EXIF, light and sharpness, and whether it can be used."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from surfkit.apps.sfm.exif import Exif, read_exif
from surfkit.apps.sfm.xmp import panorama_kind
from surfkit.core.check import BadInput, few
from surfkit.core.codec import read_json
from surfkit.core.events import Progress, Warned, emit
from surfkit.io.datasets.pixel_interpretation import decide
from surfkit.scene.photo_names import HEIF_SUFFIXES, PICTURE_SUFFIXES
from surfkit.scene.photos import open_header, photo_size, read_draft, require_heif
from surfkit.scene.pixels import DEFAULT_PIXELS, Alpha, Pixels

PHOTOGRAPHS_FILE = "photographs.json"
"""File of what was found."""
RAW_SUFFIXES = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf"})
"""Photographs that Pillow does not decode."""
HIDDEN_PREFIXES = (".", "@eaDir")
"""What names begin with that programs, and Synology's disks, keep for themselves."""
DRAFT_PX = 512
"""At this size light and sharpness are measured."""
MAX_READER_THREADS = 8
"""Photographs that are read at once."""
PHOTOGRAPHS_VERSION = 4
"""Changes when more is found in a photograph: it is looked at again then."""
PANORAMA_PROBLEM = "a panorama"
"""Begins the problem of one."""
MIN_MEAN_GREY, MIN_GREY_DEVIATION = 8.0, 3.0
"""Mean and standard deviation of grey levels, 0 to 255, below which a photograph shows nothing."""


@dataclass(frozen=True)
class Photo:
    """A photograph of the folder.

    Attributes:
        name: Path below the folder, with slashes.
        stamp: Size in bytes and time of the file: when they change, it is looked at again.
        digest: Of all its bytes, and of how they are read where that is unusual.
        size: Width and height as stored, the rotation in EXIF not applied.
        exif: What it says of itself.
        pixels: Digest of the pixels of its draft, equal for copies.
        light: Mean grey level, 0 to 255.
        contrast: Standard deviation of grey levels.
        sharpness: Standard deviation of the Laplacian over the contrast, of the draft.
        problem: Why it cannot be used; None if it can.
        mask: Digest of its mask; empty without one.
        reading: What the values of the file mean.
        edition: `PHOTOGRAPHS_VERSION` of the code that looked at it.
    """

    name: str
    stamp: tuple[int, int]
    digest: str = ""
    size: tuple[int, int] = (0, 0)
    exif: Exif = Exif()
    pixels: str = ""
    light: float = 0.0
    contrast: float = 0.0
    sharpness: float = 0.0
    problem: str | None = None
    mask: str = ""
    reading: Pixels = DEFAULT_PIXELS
    edition: int = 0

    @property
    def usable(self) -> bool:
        """Whether it goes into the reconstruction."""
        return self.problem is None

    def shows_what(self, other: Photo) -> bool:
        """Whether it has the pixels of another, also where only EXIF was written anew, or is the same file, also where
        transparent pixels are read otherwise now."""
        return self.pixels == other.pixels or self.stamp == other.stamp


def look(
    folder: Path,
    known: Sequence[Photo] = (),
    without: Path | None = None,
    others: bool = False,
    alpha: Alpha | None = None,
) -> list[Photo]:
    """All photographs below a folder, in the order of their names.

    Args:
        folder: Photographs, in folders or not.
        known: What an earlier call found; photographs that have not changed are taken from it.
        without: A folder in which no photographs are, as that of the masks.
        others: Whether there are photographs elsewhere, so that there may be none here.
        alpha: What becomes of transparent pixels.

    Raises:
        BadInput: There is no such folder, or no photograph that can be used.
    """
    if not folder.is_dir():
        raise BadInput(f"{folder}: {'a file' if folder.exists() else 'no such folder'}; name a folder of photographs")
    files = files_of(folder, without)
    paths = [path for path in files if path.suffix.lower() in PICTURE_SUFFIXES]
    if other := [path.name for path in files if path.suffix.lower() in RAW_SUFFIXES]:
        emit(Warned(f"{folder}: {len(other)} files cannot be read: {few(other)}; convert them to JPEG"))
    if heic := [path for path in paths if path.suffix.lower() in HEIF_SUFFIXES]:
        try:
            require_heif(f"{folder}: reading {len(heic)} HEIC photographs")
        except BadInput as error:
            if len(heic) == len(paths) and not others:
                raise
            emit(Warned(f"{error}; they are left out"))
            paths = [path for path in paths if path.suffix.lower() not in HEIF_SUFFIXES]
    if not paths and not others:
        raise BadInput(f"{folder}: no photographs ({', '.join(sorted(PICTURE_SUFFIXES))}) in it or in folders inside")
    return look_at(folder, paths, known, alpha, ("--alpha",))


def look_at(
    folder: Path,
    paths: Sequence[Path],
    known: Sequence[Photo] = (),
    alpha: Alpha | None = None,
    options: Sequence[str] = (),
) -> list[Photo]:
    """Some photographs below a folder, in the order of `paths`; `known` and `alpha` as for `look`, `options` as for
    `decide`."""
    before = {photo.name: photo for photo in known}
    decided = decide({path.relative_to(folder).as_posix(): path for path in paths}, alpha, options=options)
    for line in decided.lines:
        emit(Warned(line))
    found = []
    with ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_READER_THREADS)) as pool:
        for photo in pool.map(lambda path: _look_unless_known(folder, path, before, decided.pixels), paths):
            found.append(photo)
            emit(Progress("looking at photographs", len(found), len(paths)))
    if whole := [photo.name for photo in found if (photo.problem or "").startswith(PANORAMA_PROBLEM)]:
        emit(
            Warned(
                f"{folder}: {len(whole)} of {len(found)} photographs are panoramas by their XMP, {few(whole)}: no "
                "cameras are found for them, and they are left out; Metashape, COLMAP and OpenSfM find them, and "
                "their equirectangular ones are read"
            )
        )
    return _mark_copies(found)


def known_photographs(record: Path) -> Sequence[Photo]:
    """What an earlier call found and was kept in a file; none where there is none that can be read."""
    try:
        return read_json(record, tuple[Photo, ...])
    except BadInput:
        return ()


def _mark_copies(photos: Sequence[Photo]) -> list[Photo]:
    """The photographs, of which copies of one before them are marked as such."""
    first: dict[str, str] = {}
    marked = []
    for photo in photos:
        same = first.setdefault(photo.pixels, photo.name) if photo.usable else photo.name
        marked.append(photo if same == photo.name else replace(photo, problem=f"a copy of {same}"))
    return marked


def blurred_below(photos: Sequence[Photo]) -> float:
    """The sharpness below which a photograph is far less sharp than most of the folder."""
    usable = [photo.sharpness for photo in photos if photo.usable]
    return 0.4 * float(np.median(usable)) if usable else 0.0


def lens_groups(photos: Sequence[Photo]) -> list[int]:
    """The number of the lens of each photograph, from 0: equal for one camera, size and focal length."""
    keys = [(photo.exif.which, photo.size, photo.exif.focal_px and round(photo.exif.focal_px)) for photo in photos]
    numbers = {key: number for number, key in enumerate(Counter(keys))}
    return [numbers[key] for key in keys]


def files_of(folder: Path, without: Path | None = None) -> list[Path]:
    """All files below a folder, but for those in one of these folders, and those that programs keep for themselves, as
    thumbnails. Folders that links lead to come after all others, so that each folder is looked into once, by its own
    name if it is inside."""
    found, seen, starts = [], set() if without is None else {os.path.realpath(without)}, [folder]
    for start in starts:
        for here, folders, names in os.walk(start):
            if (place := os.path.realpath(here)) in seen:
                folders.clear()
                continue
            seen.add(place)
            folders[:] = sorted(name for name in folders if not name.startswith(HIDDEN_PREFIXES))
            starts += [path for name in folders if (path := Path(here, name)).is_symlink()]
            found += [Path(here, name) for name in names if not name.startswith(HIDDEN_PREFIXES)]
    return sorted(path for path in found if path.is_file() or path.is_symlink())


def _look_unless_known(folder: Path, path: Path, known: Mapping[str, Photo], readings: Mapping[str, Pixels]) -> Photo:
    name = path.relative_to(folder).as_posix()
    try:
        stat = path.stat()
    except OSError as error:
        return Photo(name, (0, 0), problem=f"a link that leads nowhere ({error.strerror})")
    stamp = (stat.st_size, stat.st_mtime_ns)
    if not _is_text(name):
        return Photo(name, stamp, problem="its name is not UTF-8, so that COLMAP cannot name it; rename it")
    before = known.get(name)
    wanted = Photo(name, stamp, reading=readings[name], edition=PHOTOGRAPHS_VERSION)
    if before is not None and (before.stamp, before.reading, before.edition) == (
        stamp,
        wanted.reading,
        PHOTOGRAPHS_VERSION,
    ):
        copy = (before.problem or "").startswith("a copy of")
        return replace(before, problem=None) if copy else before
    try:
        return _look(path, wanted)
    except BadInput as error:
        return replace(wanted, problem=str(error).removeprefix(f"{path}: "))


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:  # bytes that Python could not decode
        return False
    return True


def _look(path: Path, photo: Photo) -> Photo:
    size = photo_size(path)
    exif, kind = open_header(path, lambda image: (read_exif(image, size), panorama_kind(image.info.get("xmp"))))
    draft = read_draft(path, DRAFT_PX, photo.reading)
    grey = draft.astype(np.float32).mean(2)
    light, contrast = float(grey.mean()), float(grey.std())
    problem = None
    if contrast < MIN_GREY_DEVIATION:
        problem = "black" if light < MIN_MEAN_GREY else "of one colour"
    if kind is not None:
        problem = f"{PANORAMA_PROBLEM} ({kind})"
    return replace(
        photo,
        digest=hashlib.sha256(path.read_bytes() + _said(photo.reading)).hexdigest()[:32],
        size=size,
        exif=exif,
        pixels=hashlib.sha256(draft.tobytes()).hexdigest()[:32],
        light=light,
        contrast=contrast,
        sharpness=_sharpness(grey) / max(contrast, MIN_GREY_DEVIATION),
        problem=problem,
    )


def _said(reading: Pixels) -> bytes:
    """What tells readings of one file apart; nothing of the usual one."""
    return b"" if reading == DEFAULT_PIXELS else repr(reading).encode()


def _sharpness(grey: np.ndarray) -> float:
    """Standard deviation of the Laplacian of (h, w) grey levels."""
    if min(grey.shape) < 3:
        return 0.0
    middle = grey[1:-1, 1:-1]
    return float((grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * middle).std())
