"""Matches by distances of descriptors, above which there are none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist
from surfkit.plugin import BadInput, FeatureMatcher, MatchInput


@dataclass(frozen=True)
class NewPart(FeatureMatcher):
    """Mutual nearest neighbours up to a distance."""

    most: float = 0.7
    """Largest distance between descriptors of length 1."""

    def __post_init__(self) -> None:
        if not 0 < self.most <= 2:
            raise BadInput(f"new-part.most is {self.most}; it must lie between 0 and 2")

    def match(self, given: MatchInput) -> Iterator[np.ndarray]:
        """See `FeatureMatcher.match`."""
        for names in given.pairs:
            one, two = (given.features(name).descriptors.astype(np.float64) for name in names)
            lengths = (np.linalg.norm(each, axis=1, keepdims=True) for each in (one, two))
            away = cdist(*(each / np.maximum(length, 1e-9) for each, length in zip((one, two), lengths, strict=True)))
            there, back, rows = away.argmin(1), away.argmin(0), np.arange(len(one))
            kept = (back[there] == rows) & (away[rows, there] <= self.most)
            yield np.column_stack([rows[kept], there[kept]]).astype(np.uint32)
