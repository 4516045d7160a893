"""The points being optimised: one table, whose columns move together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from surfkit.primitives.storage import Storage

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
        storage: Where columns of points are made.
    """

    params: Columns
    exp_avg: Columns
    exp_avg_sq: Columns
    stats: Columns = field(default_factory=dict)
    shared: Columns = field(default_factory=dict)
    storage: Storage = Storage()

    @classmethod
    def fresh(cls, params: Columns, shared: Iterable[str] = (), storage: Storage | None = None) -> Points:
        """Points that have not been optimised yet; `shared` names the parameters that belong to no point."""
        common = {name: params[name] for name in shared}
        own = {name: value for name, value in params.items() if name not in common}
        return cls(own, {}, {}, shared=common).to(storage or Storage()).begun_anew()

    def begun_anew(self) -> Points:
        """These points with moments of 0."""

        def zeros(name: str, value: Tensor) -> Tensor:
            return torch.zeros_like(value) if name in self.shared else self.storage.zeros(len(value), value)

        first, second = ({name: zeros(name, value) for name, value in self.all_params().items()} for _ in range(2))
        return replace(self, exp_avg=first, exp_avg_sq=second)

    def __len__(self) -> int:
        return len(self.params["means"])

    @property
    def groups(self) -> tuple[Columns, Columns, Columns, Columns, Columns]:
        """All columns, in the order of the fields."""
        return self.params, self.exp_avg, self.exp_avg_sq, self.stats, self.shared

    @property
    def nbytes(self) -> int:
        """That all columns take."""
        return sum(value.nbytes for group in self.groups for value in group.values())

    @property
    def device(self) -> torch.device:
        """Where they are."""
        return self.params["means"].device

    def all_params(self) -> Columns:
        """Every trainable value, per point and shared."""
        return self.params | self.shared

    def stat(self, name: str, *shape: int) -> Tensor:
        """(N, *shape) a policy's own column, zeros the first time it is asked for."""
        if name not in self.stats:
            like = self.params["means"].new_empty(0, *shape)
            self.stats[name] = self.storage.zeros(len(self), like)
        return self.stats[name]

    def with_params(self, params: Columns) -> Points:
        """These points with other values of some parameters, (N, ...) each."""
        return replace(self, params=self.params | {name: self.storage.held(value) for name, value in params.items()})

    def take(self, rows: Tensor) -> Points:
        """The points of a mask or of indices, copied."""
        taken = self.listed()
        taken.rearrange(rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows)
        return taken

    def append(self, params: Columns) -> Points:
        """These points and new rows, whose moments and statistics start at zero."""
        joined = self.listed()
        joined.rearrange(torch.arange(len(self) + len(params["means"]), device=self.device), params)
        return joined

    def listed(self) -> Points:
        """The same columns, in lists of their own: to put others in their place does not change these points."""
        params, first, second, stats, shared = map(dict, self.groups)
        return Points(params, first, second, stats, shared, self.storage)

    def to_rearrange(self) -> Points:
        """What to rearrange in place of these points: on a GPU, whose memory may give out half-way, the same columns in
        lists of their own, as it can be done once more then; elsewhere, where the run goes back, these points."""
        return self.listed() if self.device.type == "cuda" else self

    def rearrange(self, rows: Tensor, added: Mapping[str, Tensor] | None = None) -> None:
        """Let the points of some rows be all that there are, in this order.

        Each column is made anew before the next: where nobody else holds it, no more than one stands twice.

        Args:
            rows: (K,) int64 of these N points, or from N on of those that are added.
            added: Raw parameters of new points, (M, ...) each, whose moments and statistics are 0.
        """
        count, rows = len(self), rows.to(self.device)
        new = (rows >= count).nonzero()[:, 0] if added is not None else None
        there, which = (rows, None) if new is None else (rows.clamp_max(count - 1), rows[new] - count)
        for group in self.groups[:4]:
            for name in [name for name in group if name not in self.shared]:
                value = group[name]
                found = self.storage.empty(len(rows), value)
                torch.index_select(value.detach(), 0, there, out=found)
                if new is not None:
                    found[new] = added[name][which] if group is self.params else 0  # type: ignore[index]
                group[name] = found
                del value, found  # before the next is made

    def to(self, where: Storage | torch.device | str) -> Points:
        """These points in another storage, or in the memory of a device."""
        storage = where if isinstance(where, Storage) else Storage(torch.device(where))
        if storage == self.storage:
            return self

        def moved(group: Columns) -> Columns:
            return {
                name: value.to(storage.device or value.device) if name in self.shared else storage.held(value)
                for name, value in group.items()
            }

        params, first, second, stats, shared = map(moved, self.groups)
        return Points(params, first, second, stats, shared, storage)

    def with_moments(self, kind: torch.dtype) -> Points:
        """These points with moments of another type."""

        def typed(name: str, value: Tensor) -> Tensor:
            if value.dtype == kind or name in self.shared:
                return value.to(kind)
            return self.storage.empty(len(value), value[:0].to(kind)).copy_(value)

        first, second = (
            {name: typed(name, value) for name, value in group.items()} for group in (self.exp_avg, self.exp_avg_sq)
        )
        return replace(self, exp_avg=first, exp_avg_sq=second)
