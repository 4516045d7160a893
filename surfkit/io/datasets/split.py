"""Rules by which photographs are held out: not trained on, kept to measure with."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Collection
from dataclasses import dataclass

from surfkit.core.check import BadInput
from surfkit.core.registry import Component
from surfkit.io.datasets.raw_dataset import RawDataset


class Split(Component):
    """A rule of which photographs of a data set are held out."""

    @abstractmethod
    def held_out(self, capture: RawDataset) -> Collection[str]:
        """Names of the photographs to hold out, not all of them.

        Args:
            capture: The data set: names and poses of its photographs in its own order, sparse points.

        Raises:
            BadInput: The rule does not fit the data set.
        """


@dataclass(frozen=True)
class GauUScene(Split):
    """GauU-Scene: of n photographs, every k-th in the order of COLMAP's image numbers, k = n // ceil(n / 10)."""

    def held_out(self, capture: RawDataset) -> Collection[str]:
        """See `Split.held_out`."""
        if not capture.numbered:
            raise BadInput("is for COLMAP data sets; leave it out")
        names = [shot.name for shot in capture.shots]
        return names[:: len(names) // math.ceil(len(names) / 10)]
