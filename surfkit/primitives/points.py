"""The points being optimised, and the changes policies may ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

Columns = dict[str, Tensor]


@dataclass(frozen=True)
class Points:
    """N points as columns: whatever is kept per point lives here, so all of it moves together.

    Attributes:
        params: Trainable raw values, each (N, ...).
        exp_avg: Adam's running mean of each parameter's gradient, same shapes.
        exp_avg_sq: Adam's running mean of the squared gradient, same shapes.
        stats: What policies accumulate between edits, each (N,).
    """

    params: Columns
    exp_avg: Columns
    exp_avg_sq: Columns
    stats: Columns = field(default_factory=dict)

    @classmethod
    def fresh(cls, params: Columns) -> Points:
        """Points that have not been optimised yet."""
        zeros = [{name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2)]
        return cls(params, *zeros)

    def __len__(self) -> int:
        return len(self.params["means"])

    def stat(self, name: str) -> Tensor:
        """(N,) a policy's own column, zeros the first time it is asked for."""
        if name not in self.stats:
            self.stats[name] = self.params["means"].new_zeros(len(self))
        return self.stats[name]

    def take(self, rows: Tensor) -> Points:
        """The points of a mask or of indices, copied."""
        rows = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        return Points(*({name: value[rows] for name, value in group.items()} for group in vars(self).values()))

    def append(self, params: Columns) -> Points:
        """These points and new rows, whose moments and statistics start at zero."""
        count = len(params["means"])

        def padded(group: Columns) -> Columns:
            return {name: torch.cat([v, v.new_zeros(count, *v.shape[1:])]) for name, v in group.items()}

        joined = {name: torch.cat([value, params[name]]) for name, value in self.params.items()}
        return Points(joined, padded(self.exp_avg), padded(self.exp_avg_sq), padded(self.stats))

    def to(self, device: torch.device | str) -> Points:
        """These points on another device."""
        return Points(*({name: value.to(device) for name, value in group.items()} for group in vars(self).values()))


@dataclass(frozen=True)
class Edit:
    """A change of N points; None asks for nothing.

    Attributes:
        drop: (N,) bool, points to remove.
        clone: (N,) bool, points to copy; or int64, how many copies of each.
        split: (N,) bool, points to replace by two smaller ones.
        max_opacity: Lower every opacity to this and let the optimiser forget its past; in (0, 1).
        nudge: Added to the raw parameters of these names, shapes as there, before points are copied.
        forget: (N,) bool, points whose past the optimiser forgets.
    """

    drop: Tensor | None = None
    clone: Tensor | None = None
    split: Tensor | None = None
    max_opacity: float | None = None
    nudge: Columns | None = None
    forget: Tensor | None = None


def withheld(edit: Edit, may: Tensor) -> Edit:
    """An edit that copies and splits no others than the points of a (N,) mask.

    Of a point that was to be copied or split and may not, the rest of the edit but for its removal is left out, too: a
    nudge of it was to make up for its copies.
    """
    asked = [mask > 0 for mask in (edit.clone, edit.split) if mask is not None]
    if not asked:
        return edit
    left = ~torch.stack(asked).any(0) | may

    def kept(value: Tensor | None) -> Tensor | None:
        return None if value is None else value * left.view(-1, *[1] * (value.dim() - 1))

    nudge = None if edit.nudge is None else {name: kept(shift) for name, shift in edit.nudge.items()}
    return replace(edit, clone=kept(edit.clone), split=kept(edit.split), nudge=nudge, forget=kept(edit.forget))


def merge(edits: Sequence[Edit | None]) -> Edit | None:
    """One edit from several: a dropped point is neither cloned nor split, a split one not cloned; None if none asks.

    Of the copies that several ask for the most are made; nudges add up.
    """
    asked = [edit for edit in edits if edit is not None]
    if not asked:
        return None

    def given(name: str) -> list:
        return [value for edit in asked if (value := getattr(edit, name)) is not None]

    def most_of(name: str) -> Tensor | None:
        masks = given(name)
        if any(mask.dtype != torch.bool for mask in masks):
            masks = [mask.to(torch.int64) for mask in masks]
        return torch.stack(masks).amax(0) if masks else None

    def without(mask: Tensor | None, other: Tensor | None) -> Tensor | None:
        return mask if mask is None or other is None else mask * ~other

    drop = most_of("drop")
    split = without(most_of("split"), drop)
    clone = without(without(most_of("clone"), drop), split)
    nudge: Columns = {}
    for columns in given("nudge"):
        nudge |= {name: nudge[name] + value if name in nudge else value for name, value in columns.items()}
    return Edit(drop, clone, split, min(given("max_opacity"), default=None), nudge or None, most_of("forget"))
