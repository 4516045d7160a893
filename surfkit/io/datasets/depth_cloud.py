"""Points on the surfaces that exact depth maps show, for data sets that have such maps but no sparse points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.depth_files import DepthFile
from surfkit.io.datasets.raw_dataset import RawImage
from surfkit.scene.photos import read_photo

MAX_CLOUD_SHOTS = 200
"""Photographs that are looked at, spread evenly; all of them would take minutes each time a data set is read."""
MAX_DEPTH_POINTS = 200_000
"""All together; no pixel is taken twice."""


def sample_depth_maps(shots: Sequence[RawImage], maps: Mapping[str, DepthFile]) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) float64 positions in the input frame and (P, 3) uint8 colours of random pixels, the same ones each time.

    Maps that cannot be read are passed over, with a note.

    Args:
        shots: Photographs to train with.
        maps: Exact depth by name of the photograph, input units.
    """
    having = [shot for shot in shots if shot.name in maps]
    chosen = having[:: max(1, -(-len(having) // MAX_CLOUD_SHOTS))]
    if not chosen:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)

    def seen(at: int) -> tuple[np.ndarray, np.ndarray] | str:
        file = maps[chosen[at].name]
        try:
            return _points(chosen[at], file.read(), MAX_DEPTH_POINTS // len(chosen), at)
        except BadInput as error:
            return f"{file.path}: {error}"

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(seen, range(len(chosen))))
    parts = [answer for answer in answers if not isinstance(answer, str)]
    if faults := [answer for answer in answers if isinstance(answer, str)]:
        emit(Warned(f"{len(faults)} of {len(answers)} depth maps give no points to start from, first {faults[0]}"))
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    xyz, rgb = (np.concatenate(part) for part in zip(*parts, strict=True))
    emit(Warned(f"no sparse points: training starts from {len(xyz)} on the depth maps of {len(parts)} photographs"))
    return xyz, rgb


def _points(shot: RawImage, inverse: np.ndarray, most: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """At most so many points of one photograph, whose inverse depth is (h, w)."""
    height, width = inverse.shape
    known = np.flatnonzero(inverse.reshape(-1) > 0)
    picked = np.random.default_rng(seed).permutation(known)[:most]
    row, column = np.divmod(picked, width)
    share = np.stack([(column + 0.5) / width, (row + 0.5) / height], 1)
    rays = np.asarray(shot.camera.cam_from_img(share * (shot.camera.width, shot.camera.height))).reshape(-1, 2)
    local = np.concatenate([rays, np.ones((len(rays), 1))], 1) / inverse[row, column, None].astype(np.float64)
    xyz = (local - shot.pose[:3, 3]) @ shot.pose[:3, :3]
    return xyz, read_photo(shot.path, (width, height))[:, row, column].T.numpy()
