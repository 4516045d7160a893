"""A rule of which photographs are held out."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from surfkit.plugin import BadInput, RawDataset, Split


@dataclass(frozen=True)
class NewPart(Split):
    """Hold out every so many photographs in the order of their names, beginning with a chosen one."""

    every: int = 8
    """One of so many photographs is held out."""

    first: int = 0
    """Position of the first that is held out, from 0."""

    def __post_init__(self) -> None:
        if self.every < 2 or not 0 <= self.first < self.every:
            raise BadInput(f"new-part.every {self.every}, first {self.first}: give 2 or more, and 0 to every - 1")

    def held_out(self, capture: RawDataset) -> Collection[str]:
        """See `Split.held_out`."""
        return sorted(shot.name for shot in capture.shots)[self.first :: self.every]
