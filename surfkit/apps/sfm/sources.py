"""Where the photographs of a set lie: in a folder, and frames of its videos elsewhere; and their masks."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.inspect_photos import Photo, files_of, known_photographs, look, look_at
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.video_frames import ExtractedFrames, take_frames
from surfkit.core.check import BadInput, few
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.masks import MASK_SUFFIXES, check_mask, find_masks, masked_name, read_mask
from surfkit.io.datasets.masks import MASKS_FOLDER as MASKS
from surfkit.io.datasets.raw_dataset import RawImage
from surfkit.scene.photo_names import PICTURE_SUFFIXES, is_video
from surfkit.scene.scene import Mask


@dataclass(frozen=True)
class Sources:
    """Files of photographs and masks.

    Attributes:
        root: Folder of the photographs.
        videos: Names of the videos that frames are of, below the folder, with slashes.
        frames: Folder of a folder of frames for each of them, of the same name.
        masks: Of photographs that have one, by their name.
    """

    root: Path
    videos: frozenset[str] = frozenset()
    frames: Path | None = None
    masks: Mapping[str, Mask] = field(default_factory=dict)

    def path(self, name: str) -> Path:
        """The file of a photograph."""
        if self.frames is not None and name.rpartition("/")[0] in self.videos:
            return self.frames / name
        return self.root / name

    def read_mask(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """(H, W) bool of the mask of a photograph, at a width and height: False where it is to be ignored."""
        mask = self.masks[name]
        return read_mask(mask.path, size, mask.alpha).numpy()


def look_at_all(given: Path, work: Path, record: Path, settings: Settings) -> tuple[Sources, list[Photo]]:
    """The photographs of a folder and frames of its videos, or frames of one video; each with its mask.

    Args:
        given: A folder or a video.
        work: Folder that has, or gets, the frames.
        record: File of what an earlier call has found.
        settings: How frames are taken, and where masks are.

    Raises:
        BadInput: There is nothing that can be used, or masks do not fit.
    """
    known, folder, photos = known_photographs(record), work / "frames", []
    if is_video(given):
        root = given.parent
        taken = {given.name: take_frames(given, folder / given.name, settings.frame_step, settings.frames)}
    else:
        root, taken = given, _taken(given, folder, settings)
        photos = look(given, known, settings.masks, bool(taken), settings.alpha)
    sources = Sources(root, frozenset(taken), folder)
    if paths := [folder / video / name for video, found in sorted(taken.items()) for name in found.names]:
        frames = look_at(folder, paths, known)
        photos += [replace(frame, exif=Exif(camera=f"video {frame.name.rpartition('/')[0]}")) for frame in frames]
    sources, photos = with_own_masks(sources, photos)
    if settings.masks is not None:
        return _with_masks(sources, photos, settings.masks)
    if inside := [photo.name for photo in photos if MASKS in photo.name.lower().split("/")[:-1]]:
        said = f"{len(inside)} files in folders called {MASKS} are taken for photographs: {few(inside)}"
        emit(Warned(f"{said}; if they are masks, give --masks FOLDER"))
    if beside := _called_as_masks([photo.name for photo in photos]):
        said = f"{len(beside)} files are called as masks of the photographs beside them, and taken for photographs"
        emit(Warned(f"{said}: {few(beside)}; if they are masks, move them to a folder and give --masks FOLDER"))
    return sources, photos


def _called_as_masks(names: Sequence[str]) -> list[str]:
    """Those that are called as the mask of another one in the same folder is."""
    small = [PurePosixPath(name.lower()) for name in names]
    known = {*small, *(path.with_suffix("") for path in small)}
    found = [(name, path, masked_name(path.name)) for name, path in zip(names, small, strict=True)]
    return [name for name, path, of in found if of and path.with_name(of) in known]


def _taken(root: Path, folder: Path, settings: Settings) -> dict[str, ExtractedFrames]:
    """Frames of the videos of a folder, by their names; those that cannot be read are named and left out."""
    files = files_of(root, settings.masks)
    pictures = {path.with_suffix("").as_posix().lower() for path in files if path.suffix.lower() in PICTURE_SUFFIXES}
    videos = [path for path in files if is_video(path)]
    if live := [path for path in videos if path.with_suffix("").as_posix().lower() in pictures]:
        names = few([path.name for path in live])
        said = f"{len(live)} videos are called as a photograph beside them, as live photos are: {names}"
        emit(Warned(f"{said}; no frames are taken of them"))
    found, wrong = {}, {}
    for path in videos:
        name = path.relative_to(root).as_posix()
        if path in live:
            continue
        try:
            found[name] = take_frames(path, folder / name, settings.frame_step, settings.frames)
        except BadInput as error:
            wrong[name] = error
    if wrong and not found and not pictures:
        raise next(iter(wrong.values()))
    if wrong:
        said = f"no frames are taken of {len(wrong)} videos, {few(list(wrong))}"
        emit(Warned(f"{said}: {next(iter(wrong.values()))}"))
    return found


def _with_masks(sources: Sources, photos: Sequence[Photo], folder: Path) -> tuple[Sources, list[Photo]]:
    """The same with the masks of a folder, or BadInput for one that has not the shape of its photograph."""
    shots = [RawImage(photo.name, np.eye(4), None, sources.path(photo.name)) for photo in photos]
    masks = find_masks(sources.root, folder.absolute(), shots)
    masks = {name: mask for name, mask in masks.items() if mask.path.is_relative_to(folder.absolute())}
    if not masks:
        named = "NAME.jpg.png or NAME.png, as the photograph NAME.jpg"
        raise BadInput(f"--masks {folder}: no picture in it has the name of a photograph; call masks {named}")
    idle = [path.name for path in sorted(folder.absolute().rglob("*")) if path.suffix.lower() in MASK_SUFFIXES]
    idle = [name for name in idle if name not in {mask.path.name for mask in masks.values()}]
    if idle:
        emit(Warned(f"--masks {folder}: {len(idle)} masks have the name of no photograph: {few(idle)}"))
    return with_masks(sources, photos, masks)


def with_masks(sources: Sources, photos: Sequence[Photo], masks: Mapping[str, Mask]) -> tuple[Sources, list[Photo]]:
    """The same with masks by the names of photographs.

    Raises:
        BadInput: A mask is damaged or has not the shape of its photograph.
    """
    found = []
    for photo in photos:
        digest = photo.mask
        if photo.usable and (mask := masks.get(photo.name)):
            check_mask(mask.path, photo.size)
            digest = hashlib.sha256(mask.path.read_bytes()).hexdigest()[:32]
            digest = f"alpha {digest}" if mask.alpha else digest
        found.append(replace(photo, mask=digest))
    return replace(sources, masks={**sources.masks, **masks}), found


def with_own_masks(sources: Sources, photos: Sequence[Photo]) -> tuple[Sources, list[Photo]]:
    """The same with the opacity of photographs as their masks, where it is to be one, and no others."""
    own = {p.name: f"opacity {p.digest}" for p in photos if p.usable and p.reading.alpha == "mask"}
    masks = {name: Mask(sources.path(name), alpha=True) for name in own}
    return replace(sources, masks=masks), [replace(photo, mask=own.get(photo.name, "")) for photo in photos]
