"""Features of photographs, kept in a file for each photograph and setting."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np
import torch

from surfkit.apps.sfm.base import Features, Find
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.sources import Sources
from surfkit.core.check import BadInput, few
from surfkit.core.codec import dump
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.files import replacing
from surfkit.scene.photos import read_photo

CACHE_VERSION = "1"
"""Changes when the same photograph would give other features."""
MIN_FEATURES = 50
"""A photograph with fewer features cannot be placed."""


def feature_file(folder: Path, photo: Photo, settings: Settings) -> Path:
    """Where the features of a photograph are kept."""
    way = f"{dump(settings.features)} {settings.features.version} {settings.max_features}"
    said = f"{CACHE_VERSION} {photo.digest} {settings.longest} {way}{photo.mask and f' {photo.mask}'}"
    return folder / f"{hashlib.sha256(said.encode()).hexdigest()[:24]}.npz"


def read_features(path: Path) -> Features:
    """The features in a file, in pixels of the stored photograph."""
    with np.load(path) as file:
        return Features(file["keypoints"], file["descriptors"])


def find_features(
    photos: Sequence[Photo], sources: Sources, folder: Path, settings: Settings, device: torch.device
) -> dict[str, int]:
    """Find and keep the features of photographs that have none yet; how many each has, by name.

    Args:
        photos: Usable ones.
        sources: Where photographs and masks are.
        folder: Where features are kept.
        settings: How they are found.
        device: Where torch works.
    """
    counts: dict[str, int] = {}
    todo = []
    for photo in photos:
        path = feature_file(folder, photo, settings)
        try:
            counts[photo.name] = len(read_features(path).keypoints)
        except Exception:  # not there, or damaged, of which numpy raises whatever comes
            todo.append((photo, path))
    if todo:
        pixels = max(int(np.prod(reduced(photo.size, settings.longest))) for photo, _ in todo)
        find = settings.features.opened(settings.max_features, device)
        with ThreadPoolExecutor(settings.features.at_once(pixels)) as pool:
            waiting = {pool.submit(_keep, find, photo, path, sources, settings): photo for photo, path in todo}
            try:
                for at, future in enumerate(as_completed(waiting)):
                    counts[waiting[future].name] = future.result()
                    emit(Progress("finding features", at + 1, len(todo)))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    if bare := [photo.name for photo in photos if photo.mask and not counts[photo.name]]:
        said = f"no features are where the masks of {len(bare)} photographs keep something, {few(bare)}"
        emit(Warned(f"{said}; correct or delete masks that keep nothing"))
    return {photo.name: counts[photo.name] for photo in photos}


def _keep(find: Find, photo: Photo, path: Path, sources: Sources, settings: Settings) -> int:
    size, file = reduced(photo.size, settings.longest), sources.path(photo.name)
    try:
        found = find(read_photo(file, size, pixels=photo.reading))
    except FileNotFoundError as error:
        raise BadInput(f"{file}: was there a moment ago; give the command again") from error
    keypoints, descriptors = found.keypoints, found.descriptors
    if photo.mask:
        column, row = np.minimum(keypoints[:, :2].astype(int), np.array(size) - 1).T
        seen = sources.read_mask(photo.name, size)[row, column]
        keypoints, descriptors = keypoints[seen], descriptors[seen]
    keypoints = scaled(keypoints, size, photo.size)
    with replacing(path) as kept:
        np.savez(kept, keypoints=keypoints, descriptors=descriptors)
    return len(keypoints)


def scaled(keypoints: np.ndarray, size: tuple[int, int], onto: tuple[int, int]) -> np.ndarray:
    """(K, 4) keypoints of a photograph of a width and height, as they lie in it at another size."""
    moved = keypoints.copy()
    moved[:, :2] *= np.array(onto, np.float32) / size
    moved[:, 2] *= onto[0] / size[0]
    return moved


def reduced(size: tuple[int, int], longest: int) -> tuple[int, int]:
    """Width and height at most `longest`."""
    by = min(1.0, longest / max(size))
    return max(1, round(size[0] * by)), max(1, round(size[1] * by))
