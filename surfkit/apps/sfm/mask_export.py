"""The masks of a data set: those of the photographs, undistorted as these are."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from surfkit.apps.sfm.dataset_export import MAX_PHOTO_THREADS, file_name, undistorted
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.row_motion import RowMotion
from surfkit.apps.sfm.sources import Sources
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.files import delete_with_folders, replacing
from surfkit.io.datasets.masks import MASKS_FOLDER

CACHE_VERSION = "1"
"""Changes when the same mask would come out otherwise."""
MASKS_RECORD = "masks.json"
"""What was written; other masks are those of the user."""


def deliver_masks(
    models: Sequence[Any],
    photos: Mapping[str, Photo],
    sources: Sources,
    scene: Path,
    work: Path,
    motions: Mapping[str, RowMotion] | None = None,
) -> None:
    """Write SCENE/masks, and delete there what an earlier call wrote and belongs to no photograph any more.

    Args:
        models: pycolmap.Reconstruction, with lenses as they are.
        photos: By name.
        sources: Where the masks are.
        scene: The data set.
        work: Folder for the record of what was written.
        motions: As for `deliver`.

    Raises:
        BadInput: A mask of somebody else would be replaced.
    """
    motions = motions or {}
    try:
        before = read_json(work / MASKS_RECORD, dict[str, str])
    except BadInput:
        before = {}
    wanted: dict[str, tuple[str, str, Any]] = {}
    for model in models:
        for image in (model.image(number) for number in model.reg_image_ids()):
            if photos[image.name].mask:
                camera = model.cameras[image.camera_id]
                said = f"{CACHE_VERSION} {photos[image.name].mask} {camera.model.name} {list(camera.params)}"
                said += f" {motions[image.name]}" if image.name in motions else ""
                key = hashlib.sha256(said.encode()).hexdigest()[:24]
                wanted[f"{file_name(image.name)}.png"] = key, image.name, camera
    folder = scene / MASKS_FOLDER
    if foreign := [name for name in wanted if name not in before and (folder / name).exists()]:
        raise BadInput(f"{folder / foreign[0]} is there, and this command did not make it; move {folder} away")
    if not wanted and not before:
        return
    todo = {name: each for name, each in wanted.items() if before.get(name) != each[0] or not (folder / name).is_file()}
    write_json(work / MASKS_RECORD, before | dict.fromkeys(todo, ""))  # what a kill leaves is ours, and made again

    def write(target: str) -> None:
        _, name, camera = todo[target]
        _write(sources, name, folder / target, camera, motions.get(name))

    with ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_PHOTO_THREADS)) as pool:
        list(pool.map(write, todo))
    for name in set(before) - set(wanted):
        delete_with_folders(folder / name, scene)
    write_json(work / MASKS_RECORD, {name: key for name, (key, _, _) in wanted.items()})


def _write(sources: Sources, name: str, target: Path, camera: Any, motion: RowMotion | None) -> None:
    """A mask as the pinhole camera would have it; what the photograph does not show is black."""
    seen = sources.read_mask(name, (camera.width, camera.height)).astype(np.uint8) * 255
    straight = undistorted(np.repeat(seen[..., None], 3, 2), camera, motion)
    with replacing(target) as file:
        Image.fromarray(np.where(straight[..., 0] > 127, 255, 0).astype(np.uint8)).save(file, "PNG")
