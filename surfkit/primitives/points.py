"""The points being optimised: one table, whose columns move together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

Columns = dict[str, Tensor]


@dataclass(frozen=True)
class Points:
    """N points as columns: whatever is kept per point lives here, so all of it moves together.

    Attributes:
        params: Trainable raw values, each (N, ...).
        exp_avg: Adam's running mean of the gradient of each parameter, also of the shared ones; same shapes, float32 or
            bfloat16.
        exp_avg_sq: Adam's running mean of the squared gradient; as `exp_avg`.
        stats: What policies accumulate between edits, each (N, ...).
        shared: Trainable values that belong to no point, of any shape.
    """

    params: Columns
    exp_avg: Columns
    exp_avg_sq: Columns
    stats: Columns = field(default_factory=dict)
    shared: Columns = field(default_factory=dict)

    @classmethod
    def fresh(cls, params: Columns, shared: Iterable[str] = ()) -> Points:
        """Points that have not been optimised yet; `shared` names the parameters that belong to no point."""
        first, second = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
        common = {name: params[name] for name in shared}
        own = {name: value for name, value in params.items() if name not in common}
        return cls(own, first, second, shared=common)

    def __len__(self) -> int:
        return len(self.params["means"])

    def all_params(self) -> Columns:
        """Every trainable value, per point and shared."""
        return self.params | self.shared

    def stat(self, name: str, *shape: int) -> Tensor:
        """(N, *shape) a policy's own column, zeros the first time it is asked for."""
        if name not in self.stats:
            self.stats[name] = self.params["means"].new_zeros(len(self), *shape)
        return self.stats[name]

    def take(self, rows: Tensor) -> Points:
        """The points of a mask or of indices, copied."""
        rows = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        return replace(
            self,
            params={name: value[rows] for name, value in self.params.items()},
            stats={name: value[rows] for name, value in self.stats.items()},
            exp_avg={name: value if name in self.shared else value[rows] for name, value in self.exp_avg.items()},
            exp_avg_sq={name: value if name in self.shared else value[rows] for name, value in self.exp_avg_sq.items()},
        )

    def append(self, params: Columns) -> Points:
        """These points and new rows, whose moments and statistics start at zero."""
        count = len(params["means"])

        def padded(group: Columns) -> Columns:
            return {
                name: value if name in self.shared else torch.cat([value, value.new_zeros(count, *value.shape[1:])])
                for name, value in group.items()
            }

        joined = {name: torch.cat([value, params[name]]) for name, value in self.params.items()}
        return Points(joined, padded(self.exp_avg), padded(self.exp_avg_sq), padded(self.stats), self.shared)

    def with_moments(self, kind: torch.dtype) -> Points:
        """These points with moments of another type."""
        first, second = (
            {name: value.to(kind) for name, value in group.items()} for group in (self.exp_avg, self.exp_avg_sq)
        )
        return replace(self, exp_avg=first, exp_avg_sq=second)

    def to(self, device: torch.device | str) -> Points:
        """These points on another device."""
        return Points(*({name: value.to(device) for name, value in group.items()} for group in vars(self).values()))
