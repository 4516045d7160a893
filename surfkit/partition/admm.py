"""What blocks agree on: the mean of all copies of a point, and how strongly copies are pulled to it (ADMM)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.losses.consensus import Consensus, column
from surfkit.primitives.points import Columns

RHO_FACTOR = 2.0
"""By which rho is changed."""


@dataclass(frozen=True)
class PointCopies:
    """The points of one block.

    Attributes:
        ids: (N,) int64, ascending: which point of the coarse model each one is.
        params: Raw parameters, each (N, ...).
    """

    ids: Tensor
    params: Columns

    def of(self, ids: Tensor) -> tuple[Tensor, Tensor]:
        """Rows of those points among (M,) ascending `ids` that the block has, and their positions among these."""
        at = torch.searchsorted(ids, self.ids).clamp_max(max(0, len(ids) - 1))
        rows = (ids[at] == self.ids).nonzero()[:, 0] if len(ids) else torch.zeros(0, dtype=torch.int64)
        return rows, at[rows]


@dataclass(frozen=True)
class ConsensusState:
    """What blocks have agreed on at the end of a round.

    Attributes:
        ids: (M,) int64, ascending: the points that two or more blocks have.
        z: The mean of their copies, raw parameters, each (M, ...).
        rho: Of each raw parameter.
    """

    ids: Tensor
    z: Columns
    rho: dict[str, float]


def mean_copies(blocks: Sequence[PointCopies], ids: Tensor) -> tuple[Columns, Tensor]:
    """Mean of all copies of (M,) points, zeros where there is none; (M,) how many copies there are."""
    counts = torch.zeros(len(ids), dtype=torch.int64)
    sums: Columns = {}
    for block in blocks:
        rows, at = block.of(ids)
        counts[at] += 1
        for name, value in block.params.items():
            total = sums.setdefault(name, torch.zeros(len(ids), *value.shape[1:], dtype=torch.float64))
            total[at] += value[rows].double()
    by = counts.clamp_min(1)
    like = blocks[0].params
    return {n: (v / by.view(-1, *[1] * (v.dim() - 1))).to(like[n].dtype) for n, v in sums.items()}, counts


def common(ids: Sequence[Tensor]) -> Tensor:
    """(M,) int64, ascending: the points that two or more blocks have, given those of each block."""
    every, counts = torch.cat(list(ids)).unique(return_counts=True)
    return every[counts > 1]


def agree(blocks: Sequence[PointCopies], rule: Consensus, before: ConsensusState | None, index: int) -> ConsensusState:
    """What blocks agree on after step `index`.

    Args:
        blocks: Of each block at least the points that others have too.
        rule: The settings.
        before: What they have agreed on a round before, if any.
        index: The step.
    """
    ids = common([block.ids for block in blocks]) if before is None else before.ids
    z, counts = mean_copies(blocks, ids)
    if before is None:
        return ConsensusState(ids, z, {name: rule.begins_with(name) / max(1, len(ids)) for name in z})
    rho = dict(before.rho)
    for name in z if index <= rule.balance_until else ():
        apart = sum(_squares(block, before.ids, z, name) for block in blocks) ** 0.5
        moved = (z[name].double() - before.z[name].double()).reshape(len(counts), -1).square().sum(1)
        change = rho[name] * float((counts * moved).sum()) ** 0.5
        if apart > rule.balance * change:
            rho[name] *= RHO_FACTOR
        elif change > rule.balance * apart:
            rho[name] /= RHO_FACTOR
    return ConsensusState(before.ids, z, rho)


def _squares(block: PointCopies, ids: Tensor, z: Columns, name: str) -> float:
    """Sum of the squares of the differences between the copies in a block and the means."""
    rows, at = block.of(ids)
    return float((block.params[name][rows].double() - z[name][at].double()).square().sum())


def columns_after(block: PointCopies, stats: Columns, agreement: ConsensusState, rule: Consensus) -> Columns:
    """The columns of `Consensus` in a block for the next round, from those of the round before; none at the first.

    The sum u is in units of 1 / rho, and changes with it.
    """
    rows, at = block.of(agreement.ids)
    found: Columns = {}
    for name, x in block.params.items():
        z, u, rho = torch.zeros_like(x), torch.zeros_like(x), x.new_zeros(len(x))
        z[rows] = agreement.z[name][at]
        rho[rows] = agreement.rho[name] / max(1, len(agreement.ids))
        old = stats.get(column("rho", name))
        if old is not None and bool(old.any()):
            ratio = (old[rows] / rho[rows]).view(-1, *[1] * (x.dim() - 1))
            u[rows] = (stats[column("u", name)][rows] + rule.relaxation * (x[rows] - z[rows])) * ratio
        found |= {column("z", name): z, column("u", name): u, column("rho", name): rho}
    return found
