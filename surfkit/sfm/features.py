"""SIFT features of photographs, kept in a file for each photograph and setting (Lowe, IJCV 2004; RootSIFT)."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, few
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.files import replacing
from surfkit.scene.photos import read_photo
from surfkit.sfm.engine import load_engine
from surfkit.sfm.photographs import Photo
from surfkit.sfm.settings import Settings
from surfkit.sfm.sources import Sources

RECIPE = "1"
"""Changes when the same photograph would give other features."""
FEWEST = 50
"""A photograph with fewer features cannot be placed."""
BYTES_PER_PIXEL = 160
"""That SIFT takes with the photograph doubled in size first: five levels of an octave and as many differences."""
MOST_BYTES = 2 << 30
"""Of all threads together."""


@dataclass(frozen=True)
class Features:
    """Features of a photograph.

    Attributes:
        keypoints: (K, 4) float32 x, y in pixels of the stored photograph, scale, orientation.
        descriptors: (K, 128) uint8.
    """

    keypoints: np.ndarray
    descriptors: np.ndarray


def feature_file(folder: Path, photo: Photo, settings: Settings) -> Path:
    """Where the features of a photograph are kept."""
    said = f"{RECIPE} {photo.digest} {settings.longest} {settings.features}{photo.mask and f' {photo.mask}'}"
    return folder / f"{hashlib.sha256(said.encode()).hexdigest()[:24]}.npz"


def read_features(path: Path) -> Features:
    """The features in a file."""
    with np.load(path) as file:
        return Features(file["keypoints"], file["descriptors"])


def find_features(photos: Sequence[Photo], sources: Sources, folder: Path, settings: Settings) -> dict[str, int]:
    """Find and keep the features of photographs that have none yet; how many each has, by name.

    Args:
        photos: Usable ones.
        sources: Where photographs and masks are.
        folder: Where features are kept.
        settings: How they are found.
    """
    engine = load_engine()
    counts: dict[str, int] = {}
    todo = []
    for photo in photos:
        path = feature_file(folder, photo, settings)
        try:
            counts[photo.name] = len(read_features(path).keypoints)
        except Exception:  # not there, or damaged, of which numpy raises whatever comes
            todo.append((photo, path))
    if todo:
        pixels = max(int(np.prod(_reduced(photo.size, settings.longest))) for photo, _ in todo)
        threads = max(1, min(os.cpu_count() or 1, MOST_BYTES // (BYTES_PER_PIXEL * pixels)))
        threads = 1 if engine.has_cuda else threads
        with ThreadPoolExecutor(threads) as pool:
            waiting = {pool.submit(_keep, engine, photo, path, sources, settings): photo for photo, path in todo}
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


def _keep(engine: Any, photo: Photo, path: Path, sources: Sources, settings: Settings) -> int:
    options = engine.FeatureExtractionOptions()
    options.use_gpu = engine.has_cuda
    options.num_threads = 1
    options.max_image_size = settings.longest
    options.sift.max_num_features = settings.features
    extractor = engine.FeatureExtractor.create(options, engine.Device.auto)
    size, file = _reduced(photo.size, settings.longest), sources.path(photo.name)
    try:
        grey = read_photo(file, size, pixels=photo.reading).float().mean(0).round().byte().numpy()
    except FileNotFoundError as error:
        raise BadInput(f"{file}: was there a moment ago; give the command again") from error
    found, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
    keypoints = np.array(engine.keypoints_to_matrix(found), np.float32).reshape(-1, 4)
    descriptors = np.array(descriptors.data, np.uint8).reshape(-1, 128)
    if photo.mask:
        column, row = np.minimum(keypoints[:, :2].astype(int), np.array(size) - 1).T
        seen = sources.read_mask(photo.name, size)[row, column]
        keypoints, descriptors = keypoints[seen], descriptors[seen]
    keypoints[:, :2] *= np.array(photo.size, np.float32) / size
    keypoints[:, 2] *= photo.size[0] / size[0]
    with replacing(path) as file:
        np.savez(file, keypoints=keypoints, descriptors=descriptors)
    return len(keypoints)


def _reduced(size: tuple[int, int], longest: int) -> tuple[int, int]:
    """Width and height at most `longest`."""
    by = min(1.0, longest / max(size))
    return max(1, round(size[0] * by)), max(1, round(size[1] * by))
