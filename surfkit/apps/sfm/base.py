"""The contracts of what finds features in photographs, and of what compares the features of two photographs."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from surfkit.core.registry import Component


@dataclass(frozen=True)
class Features:
    """Features of a photograph.

    Attributes:
        keypoints: (K, 4) float32 x, y in pixels, (0.5, 0.5) in the middle of the first one; scale (standard deviation
            of the blob, pixels) and orientation (radians, from x towards y), 1 and 0 where there are none.
        descriptors: (K, D) uint8 or float16.
    """

    keypoints: np.ndarray
    descriptors: np.ndarray


Find = Callable[[Tensor], Features]
"""Finds the features of a photograph, (3, H, W) uint8 RGB on the CPU, in its pixels."""


class FeatureExtractor(Component):
    """A way to find features in photographs: points that other photographs of the place have too, with descriptors.

    The same photograph gives the same features. The `version` is raised when the same settings give others: those that
    are kept are not used again. Masks are no concern of it: what lies under them is taken away afterwards.
    """

    descriptors: ClassVar[str]
    """What the descriptors are; matchers go by it. `sift` is for 128 bytes in the order of Lowe and OpenCV."""
    in_torch: ClassVar[bool] = True
    """Whether it works on the device that is given."""
    version: ClassVar[int] = 1

    @abstractmethod
    def opened(self, most: int, device: torch.device) -> Find:
        """What finds up to about `most` features of a photograph.

        Raises:
            BadInput: A package or weights are missing.
        """

    def at_once(self, pixels: int) -> int:
        """How many photographs of so many pixels are looked at at the same time, each in a thread of its own."""
        return 1

    def refuse_missing(self) -> None:
        """BadInput if what it needs is not on this machine; asked before anything else is done."""
        return None


@dataclass(frozen=True)
class MatchInput:
    """What a matcher is given.

    Attributes:
        pairs: Names of the photographs to compare.
        features: Gives the features of a photograph by its name, in its pixels as it was reduced for them.
        sizes: Width and height of each photograph so reduced, by its name.
        descriptors: What the descriptors are, `FeatureExtractor.descriptors`.
        device: Where torch works.
        database: COLMAP's, with the features of all photographs; descriptors only if they are `sift`.
        listed: A file of the pairs as COLMAP reads it.
    """

    pairs: Sequence[tuple[str, str]]
    features: Callable[[str], Features]
    sizes: Mapping[str, tuple[int, int]]
    descriptors: str
    device: torch.device
    database: Path
    listed: Path


class FeatureMatcher(Component):
    """A way to find which features of two photographs show the same point.

    Some of the matches may be wrong: afterwards COLMAP keeps those that one motion of the camera explains. The
    `version` is raised when the same settings give other matches.
    """

    in_torch: ClassVar[bool] = True
    """Whether it works on the device that is given."""
    version: ClassVar[int] = 1

    @abstractmethod
    def match(self, given: MatchInput) -> Iterator[np.ndarray]:
        """(M, 2) uint32 of each pair in turn: positions of features of the first and of the second photograph. A
        feature is in one match at most."""

    def refuse_unfit(self, extractor: FeatureExtractor) -> None:
        """BadInput if it cannot compare descriptors of this kind."""
        return None

    def refuse_missing(self, descriptors: str) -> None:
        """BadInput if what it needs for these descriptors is not on this machine; asked before all other work."""
        return None
