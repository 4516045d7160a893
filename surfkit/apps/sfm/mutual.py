"""Mutual nearest neighbours in torch, for descriptors of any kind."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.apps.sfm.base import FeatureMatcher, MatchInput
from surfkit.core.check import require_within

BATCH_DESCRIPTORS = 4096
"""Descriptors that are compared with all of another photograph at once: their similarities are held in memory."""


@dataclass(frozen=True)
class Mutual(FeatureMatcher):
    """Mutual nearest neighbours in torch, nearer than the next by a ratio (Lowe, IJCV 2004): for all features, on a GPU
    too."""

    ratio: float = 0.8
    """Most that the distance of a match may be, as a share of that to the second nearest, in both directions. 0.8 is
    usual for SIFT; learnt descriptors are compared with 0.95 or so, or with 1, which leaves this test out."""

    def __post_init__(self) -> None:
        require_within({"ratio": (0.1, 1.0)}, self)

    def match(self, given: MatchInput) -> Iterator[np.ndarray]:
        """See `FeatureMatcher.match`."""
        for names in given.pairs:
            one, two = (unit(given.features(name).descriptors, given.device) for name in names)
            yield mutual(one, two, self.ratio).cpu().numpy().astype(np.uint32)


def unit(descriptors: np.ndarray, device: torch.device) -> Tensor:
    """(K, D) float32 descriptors of length 1."""
    return torch.nn.functional.normalize(torch.from_numpy(descriptors).to(device, torch.float32), dim=1)


def mutual(one: Tensor, two: Tensor, ratio: float) -> Tensor:
    """(M, 2) positions of descriptors that are nearest to each other, and nearer than the next by a ratio.

    Args:
        one: (N, D) float32 of length 1.
        two: (P, D) likewise.
        ratio: Most that the nearest distance may be, as a share of the second.
    """
    if min(len(one), len(two)) < 2:
        return torch.zeros((0, 2), dtype=torch.long)
    there, back = _nearest(one, two, ratio), _nearest(two, one, ratio)
    rows = torch.arange(len(one), device=one.device)
    kept = (there >= 0) & (back[there.clamp_min(0)] == rows)
    return torch.stack([rows[kept], there[kept]], 1)


def _nearest(one: Tensor, two: Tensor, ratio: float) -> Tensor:
    """(N,) position of the nearest of `two`; -1 where another one is nearly as near."""
    found = []
    for part in one.split(BATCH_DESCRIPTORS):
        likeness, at = (part @ two.T).topk(2, dim=1)
        nearest, next_one = (2 - 2 * likeness).clamp_min(0).sqrt().unbind(1)
        found.append(torch.where(nearest <= ratio * next_one, at[:, 0], -1))
    return torch.cat(found)
