"""Several processes that train one model together, and what they send each other (torch.distributed, gloo)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Processes:
    """P processes, of which this is one. All of them call the same methods in the same order.

    Attributes:
        rank: Of this one, from 0.
        count: P.
    """

    rank: int
    count: int

    @classmethod
    def joined(cls) -> Processes:
        """Those of the process group that this process has joined."""
        return cls(dist.get_rank(), dist.get_world_size())

    def of_each(self, value: int) -> list[int]:
        """The numbers that the processes give, in their order."""
        found = [torch.empty(1, dtype=torch.int64) for _ in range(self.count)]
        dist.all_gather(found, torch.tensor([int(value)]))
        return [int(each) for each in found]

    def swapped(self, sent: Sequence[int]) -> list[int]:
        """The numbers that the processes have for this one, from the numbers that this one has for each."""
        found = torch.empty(self.count, dtype=torch.int64)
        dist.all_to_all_single(found, torch.tensor(list(sent)))
        return [int(each) for each in found]

    def exchanged(self, values: Tensor, sent: Sequence[int], received: Sequence[int]) -> Tensor:
        """(R, ...) what the others have for this process, of (S, ...) that this one has for them.

        Args:
            values: Rows for process 0, then those for process 1, and so on.
            sent: How many for each.
            received: How many come from each.
        """
        found = values.new_empty(sum(received), *values.shape[1:])
        dist.all_to_all_single(found, values.contiguous(), list(received), list(sent))
        return found

    def gathered(self, values: Tensor, counts: Sequence[int] | None = None) -> Tensor:
        """(sum of N, ...) the rows of all processes, one after the other, of (N, ...) of each.

        Args:
            values: Of this process.
            counts: N of each, where that is known.
        """
        plain = values.to(torch.uint8) if values.dtype == torch.bool else values
        counts = counts or self.of_each(len(values))
        found = plain.new_empty(sum(counts), *plain.shape[1:])
        for rank, part in enumerate(torch.split(found, list(counts))):
            if rank == self.rank:
                part.copy_(plain)
            if part.numel():
                dist.broadcast(part, rank)
        return found.to(values.dtype)
