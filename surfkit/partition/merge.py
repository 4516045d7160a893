"""Putting tuned blocks together: every point from the block that owns it, and no hole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.partition.base import Cells

Pieces = Callable[[], Iterator[Mapping[str, Tensor]]]
"""Gives the parameters of a model, some of its points each time."""


@dataclass(frozen=True)
class BlockContribution:
    """What one block gives to the whole.

    Attributes:
        index: Of the block.
        filled: Whether it comes from the coarse model, because the block was not tuned.
        given: Points that were there.
        kept: Points of them that the block owns.
    """

    index: int
    filled: bool
    given: int
    kept: int


@dataclass(frozen=True)
class Merge:
    """The parameters of all blocks, each point from its owner; what was not tuned is filled from the coarse model.

    Models come in pieces, as all of them together may be more than memory holds. Of a piece, "means" is (N, 3), and
    every other parameter has N rows too.

    Attributes:
        cells: Who owns what.
        coarse: Gives the pieces of the coarse model, from the first, whenever it is called.
        tuned: The same of each block that was tuned, with whatever it saw around it.
        skipped: Blocks that are to be filled.

    Raises:
        BadInput: A block has neither a result nor leave to be filled.
    """

    cells: Cells
    coarse: Pieces
    tuned: Mapping[int, Pieces]
    skipped: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        missing = sorted(set(range(self.cells.count)) - set(self.tuned) - set(self.skipped))
        if missing:
            names = ", ".join(map(str, missing))
            raise BadInput(f"merge: blocks {names} are not tuned; give the same command again to finish them")

    def shares(self) -> tuple[BlockContribution, ...]:
        """What each block gives."""
        counts = [[(len(own), int(own.sum())) for _, own in self._owned(index)] for index in range(self.cells.count)]
        sums = [(sum(given for given, _ in parts), sum(kept for _, kept in parts)) for parts in counts]
        return tuple(BlockContribution(index, index not in self.tuned, *both) for index, both in enumerate(sums))

    def pieces(self) -> Iterator[dict[str, Tensor]]:
        """The parameters, in the order of the blocks."""
        for index in range(self.cells.count):
            for params, own in self._owned(index):
                yield {name: value[own] for name, value in params.items()}

    def _owned(self, index: int) -> Iterator[tuple[Mapping[str, Tensor], Tensor]]:
        """Pieces of the model that a block comes from, and which of the points it owns."""
        for params in self.tuned.get(index, self.coarse)():
            yield params, self.cells.owner(params["means"]) == index
