"""Features of photographs, which of these are compared, and their verified matches: all ways to points begin so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.apps.sfm.colmap_database import contents, match, refuse_other
from surfkit.apps.sfm.feature_cache import MIN_FEATURES, feature_file, find_features, read_features
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.pair_selection import Pair, choose_pairs
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.sources import Sources
from surfkit.core.codec import read_json, write_json
from surfkit.core.stages import StageFolder, key_of


@dataclass(frozen=True)
class Compared:
    """Photographs that were compared.

    Attributes:
        counts: Features of each photograph, by name.
        rich: Photographs with enough of them.
        database: COLMAP's, with verified matches.
        key: Of all that the matches depend on.
    """

    counts: Mapping[str, int]
    rich: Sequence[Photo]
    database: Path
    key: str


def compare(
    stages: StageFolder,
    photos: Sequence[Photo],
    sources: Sources,
    work: Path,
    settings: Settings,
    device: torch.device,
    cameras: Mapping[str, Any] | None = None,
    poses: Mapping[str, np.ndarray] | None = None,
) -> Compared:
    """Find features and compare photographs, as far as that is still to be done.

    Args:
        stages: What is complete.
        photos: Usable ones.
        sources: Where photographs and masks are.
        work: Folder of what the stages keep.
        settings: How.
        device: Where torch works.
        cameras: As for `match`.
        poses: (4, 4) world_to_camera of each photograph, by its name, if they are known.
    """
    folder, database, listed = work / "features", work / "database.db", work / "pairs.json"
    counts = stages.run("features", "", lambda: find_features(photos, sources, folder, settings, device))
    rich = [photo for photo in photos if counts[photo.name] >= MIN_FEATURES]
    made_of = contents(rich, folder, settings, cameras)

    def descriptors(at: int) -> np.ndarray:
        return read_features(feature_file(folder, rich[at], settings)).descriptors

    def choose() -> list[Pair]:
        pairs = choose_pairs(rich, settings, descriptors, known)
        write_json(listed, pairs)
        return pairs

    known = None if poses is None else np.stack([poses[photo.name] for photo in rich])
    chosen = [settings.pairs, settings.neighbours, settings.seed, known if known is None else known.tolist()]
    key = key_of(made_of, chosen, [[photo.exif.position, photo.exif.taken] for photo in rich])
    pairs = stages.run("pairs", key, choose, lambda: list(read_json(listed, tuple[Pair, ...])))
    key = key_of(made_of, pairs)
    stages.run(
        "matches",
        key,
        lambda: match(rich, pairs, folder, database, settings, device, cameras),
        lambda: refuse_other(database, made_of),
    )
    return Compared(counts, rich, database, key)
