"""Changes of the set of points: what policies ask for, and how it is done to the points of a primitive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Points


@dataclass(frozen=True)
class Edit:
    """A change of N points, in activated terms; None asks for nothing.

    Attributes:
        drop: (N,) bool, points to remove.
        clone: (N,) bool, points to copy; or int64, how many copies of each.
        split: (N,) bool, points to replace by two smaller ones.
        max_opacity: Lower every opacity to this and let the optimiser forget its past; in (0, 1).
        move: (N, 3) local units, added to the positions.
        opacities: (N,) new opacities, between 0 and 1; NaN leaves a point's as it is.
        scale_by: (N,) factors of the scales, above 0.
        forget: (N,) bool, points whose past the optimiser forgets.

    Points are moved, dimmed and scaled before they are copied.
    """

    drop: Tensor | None = None
    clone: Tensor | None = None
    split: Tensor | None = None
    max_opacity: float | None = None
    move: Tensor | None = None
    opacities: Tensor | None = None
    scale_by: Tensor | None = None
    forget: Tensor | None = None


def apply(primitive: Primitive, points: Points, edit: Edit, generator: torch.Generator) -> Points:
    """Points after an edit: the kept in their order, then clones, then children. Moments and statistics follow rows."""
    points, added, keep = _adjusted(primitive, points, edit), [], None
    if edit.clone is not None and edit.clone.any():
        rows = torch.arange(len(points)).to(edit.clone.device).repeat_interleave(edit.clone.to(torch.int64))
        added.append({name: value[rows] for name, value in points.params.items()})
    if edit.split is not None and edit.split.any():
        rows = {name: value[edit.split] for name, value in points.params.items()}
        added.append(primitive.split(rows | points.shared, generator))
        keep = ~edit.split
    if edit.drop is not None and edit.drop.any():
        keep = ~edit.drop if keep is None else keep & ~edit.drop
    if keep is not None:
        points = points.take(keep)
    if added:
        points = points.append({name: torch.cat([rows[name] for rows in added]) for name in points.params})
    return points if edit.max_opacity is None else _dimmed(primitive, points, edit.max_opacity)


def withheld(edit: Edit, may: Tensor) -> Edit:
    """An edit that copies and splits no others than the points of a (N,) mask.

    Of a point that was to be copied or split and may not, the rest of the edit but for its removal is left out, too:
    such changes were to make up for its copies.
    """
    asked = [mask > 0 for mask in (edit.clone, edit.split) if mask is not None]
    if not asked:
        return edit
    left = ~torch.stack(asked).any(0) | may

    def kept(value: Tensor | None) -> Tensor | None:
        return None if value is None else value * left.view(-1, *[1] * (value.dim() - 1))

    def or_neutral(value: Tensor | None, neutral: float) -> Tensor | None:
        return None if value is None else torch.where(left, value, neutral)

    return replace(
        edit,
        clone=kept(edit.clone),
        split=kept(edit.split),
        move=kept(edit.move),
        opacities=or_neutral(edit.opacities, torch.nan),
        scale_by=or_neutral(edit.scale_by, 1.0),
        forget=kept(edit.forget),
    )


def merge(edits: Sequence[Edit | None]) -> Edit | None:
    """One edit from several: a dropped point is neither cloned nor split, a split one not cloned; None if none asks.

    Of the copies that several ask for the most are made; moves add up, factors of scales multiply, and of several
    opacities the lowest counts.
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
    return Edit(
        drop=drop,
        clone=without(without(most_of("clone"), drop), split),
        split=split,
        max_opacity=min(given("max_opacity"), default=None),
        move=sum(moves[1:], moves[0]) if (moves := given("move")) else None,
        opacities=_lowest(wanted) if (wanted := given("opacities")) else None,
        scale_by=torch.stack(factors).prod(0) if (factors := given("scale_by")) else None,
        forget=most_of("forget"),
    )


def _lowest(opacities: list[Tensor]) -> Tensor:
    """(N,) the lowest of several, NaN where all are."""
    found = torch.stack([torch.where(each.isnan(), torch.inf, each) for each in opacities]).amin(0)
    return torch.where(found.isinf(), torch.nan, found)


def _adjusted(primitive: Primitive, points: Points, edit: Edit) -> Points:
    """Points moved, dimmed and scaled, and their moments forgotten, where the edit asks for it."""
    params = points.params
    if edit.move is not None:
        params = primitive.moved(params, edit.move)
    if edit.opacities is not None:
        params = primitive.with_opacities(params, edit.opacities)
    if edit.scale_by is not None:
        params = primitive.scaled(params, edit.scale_by)
    points = replace(points, params=params)
    if edit.forget is None or not edit.forget.any():
        return points
    kept = ~edit.forget
    moments = [
        {name: value * kept.view(-1, *[1] * (value.dim() - 1)) for name, value in group.items()}
        for group in (points.exp_avg, points.exp_avg_sq)
    ]
    return replace(points, exp_avg=moments[0], exp_avg_sq=moments[1])


def _dimmed(primitive: Primitive, points: Points, most: float) -> Points:
    """Points with opacities of at most `most`, whose optimiser starts anew for what that has changed."""
    opacities = primitive.activate(points.params | points.shared, 0).opacities.detach()
    wanted = torch.full_like(opacities, torch.nan, dtype=torch.float64).masked_fill(opacities > most, most)
    params = primitive.with_opacities(points.params, wanted)
    anew = {name: torch.zeros_like(value) for name, value in params.items() if value is not points.params[name]}
    return replace(
        points,
        params=params,
        exp_avg=points.exp_avg | anew,
        exp_avg_sq=points.exp_avg_sq | {name: value.clone() for name, value in anew.items()},
    )
