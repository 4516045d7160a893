"""Putting tuned blocks together: every point from the block that owns it, and no hole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.partition.base import Cells


@dataclass(frozen=True)
class Share:
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


def merge(
    cells: Cells,
    coarse: Mapping[str, Tensor],
    tuned: Mapping[int, Mapping[str, Tensor]],
    skipped: frozenset[int] = frozenset(),
) -> tuple[dict[str, Tensor], tuple[Share, ...]]:
    """The parameters of all blocks, each point from its owner; what was not tuned is filled from the coarse model.

    Args:
        cells: Who owns what.
        coarse: Parameters of the coarse model; "means" is (N, 3), every other one has N rows too.
        tuned: The same of each block that was tuned, with whatever it saw around it.
        skipped: Blocks that are to be filled.

    Returns:
        Parameters in the order of the blocks, and what each gave.

    Raises:
        BadInput: A block has neither a result nor leave to be filled.
    """
    missing = sorted(set(range(cells.count)) - set(tuned) - set(skipped))
    if missing:
        names = ", ".join(map(str, missing))
        names = ", ".join(map(str, missing))
        raise BadInput(f"merge: blocks {names} are not tuned; give the same command again to finish them")
    parts, shares = [], []
    for index in range(cells.count):
        params = tuned.get(index, coarse)
        own = cells.owner(params["means"]) == index
        parts.append({name: value[own] for name, value in params.items()})
        shares.append(Share(index, index not in tuned, len(own), int(own.sum())))
    whole = {name: torch.cat([part[name] for part in parts]) for name in coarse}
    assert len(whole["means"]) == sum(share.kept for share in shares)
    return whole, tuple(shares)
