"""Changes of the set of points: what policies ask for, and how it is done to the points of a primitive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect_kind, expect_tensor
from surfkit.core.registry import class_path
from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns, Points
from surfkit.scene.scene import View

OBSERVED_EVERY = 100
"""Steps after which the columns that follow from the cameras are computed again: positions move slowly."""


@dataclass(frozen=True)
class NewPoints:
    """M points to add that are no copies of others.

    Attributes:
        params: Raw parameters, M rows of each that belongs to points.
        parent: (M,) int64, the point that each is added for: where that may not be densified, it is left out.
    """

    params: Columns
    parent: Tensor

    def __len__(self) -> int:
        return len(self.parent)

    def take(self, rows: Tensor) -> NewPoints:
        """Those of a mask or of indices."""
        return NewPoints({name: value[rows] for name, value in self.params.items()}, self.parent[rows])


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
        scatter: (N,) bool, points whose copies lie at places drawn from the point's own Gaussian; those of the others
            lie where the point is.
        new: Points to add beside the clones, such as anchors at places of their own.
        values: Raw values by name that take the place of a parameter, of all points or shared; for parameters that no
            gradient changes, such as a level of detail.

    Points are moved, dimmed and scaled, and given their values, before they are copied.
    """

    drop: Tensor | None = None
    clone: Tensor | None = None
    split: Tensor | None = None
    max_opacity: float | None = None
    move: Tensor | None = None
    opacities: Tensor | None = None
    scale_by: Tensor | None = None
    forget: Tensor | None = None
    scatter: Tensor | None = None
    new: NewPoints | None = None
    values: Columns | None = None

    @property
    def counts(self) -> tuple[int, int, int]:
        """How many points are dropped, how many added by copying or as new ones, and how many split."""
        drop, clone, split = (0 if mask is None else int(mask.sum()) for mask in (self.drop, self.clone, self.split))
        return drop, clone + (0 if self.new is None else len(self.new)), split


FLOAT_DTYPES = (torch.float32, torch.float64)
ROW_FIELDS: dict[str, tuple[tuple[torch.dtype, ...], tuple[int, ...]]] = {
    **dict.fromkeys(("drop", "split", "forget", "scatter"), ((torch.bool,), ())),
    "clone": ((torch.bool, torch.int64), ()),
    "move": (FLOAT_DTYPES, (3,)),
    **dict.fromkeys(("opacities", "scale_by"), (FLOAT_DTYPES, ())),
}
"""Types of what an edit has for each of N points, and their shapes after N."""


def apply(primitive: Primitive, points: Points, edit: Edit, generator: torch.Generator) -> Points:
    """Points after an edit: the kept in their order, then clones, children and new points."""
    edited = points.listed()
    apply_in_place(primitive, edited, edit, generator)
    return edited


def apply_in_place(
    primitive: Primitive,
    points: Points,
    edit: Edit,
    generator: torch.Generator,
    order: Callable[[Tensor], Tensor] | None = None,
) -> None:
    """Edit points in place, one column after the other, as `apply` does.

    Beside the points and the edit, this takes the new points, 8 bytes for each point there will be, and the largest
    column once more; where the edit moves, dims, scales or forgets, also the columns that this changes.

    Args:
        primitive: What the points are.
        points: If this fails, they are neither what they were nor what they should be.
        edit: The change.
        generator: Of random draws.
        order: Gives the order that all are put in, (K,) indices, from their positions (K, 3).
    """
    _adjust(primitive, points, edit)
    added, keep = [], None
    if edit.clone is not None and edit.clone.any():
        rows = torch.arange(len(points)).to(edit.clone.device).repeat_interleave(edit.clone.to(torch.int64))
        copies = {name: value[rows] for name, value in points.params.items()}
        if edit.scatter is not None:
            copies = _scattered(primitive, copies, points.shared, edit.scatter[rows], generator)
        added.append(copies)
    if edit.split is not None and edit.split.any():
        parents = {name: value[edit.split] for name, value in points.params.items()}
        children = primitive.split(parents | points.shared, generator)
        expect_rows(f"{class_path(type(primitive))}.split", children, points.params, 2 * int(edit.split.sum()))
        added.append(children)
        keep = ~edit.split
    if edit.new is not None and len(edit.new):
        added.append(edit.new.params)
    if edit.drop is not None and edit.drop.any():
        keep = ~edit.drop if keep is None else keep & ~edit.drop
    new = {name: torch.cat([rows[name] for rows in added]) for name in points.params} if added else None
    del added
    if keep is not None or new is not None or order is not None:
        rows = torch.arange(len(points)) if keep is None else keep.nonzero()[:, 0]
        rows = rows.to(points.device)
        means = points.params["means"][rows]
        if new is not None:
            means = torch.cat([means, new["means"]])
            rows = torch.cat([rows, len(points) + torch.arange(len(new["means"]), device=points.device)])
        points.rearrange(rows if order is None else rows[order(means)], new)
    if edit.max_opacity is not None:
        _dim(primitive, points, edit.max_opacity)


def sound(edit: Edit | None, count: int, policy: object, columns: Columns) -> Edit | None:
    """What a policy asks for, or BadInput if it is no edit of so many points: other masks would pass for indices, and
    what cannot be drawn would be found out in a later step, which could not tell whose it was.

    Moves are not looked at, as some policies move all points in every step, and a GPU would be waited for.

    Args:
        edit: What it gives.
        count: N points.
        policy: Named in messages.
        columns: Of points, whose types and shapes new ones must have.
    """
    if edit is None:
        return None
    name = f"{class_path(type(policy))}.edit"
    if not isinstance(edit, Edit):
        raise BadInput(f"{name} gives {type(edit).__name__}; it must be a surfkit.Edit, or None")
    for field, (kinds, shape) in ROW_FIELDS.items():
        value, wanted = getattr(edit, field), (count, *shape)
        if value is None:
            continue
        if not isinstance(value, Tensor) or value.dtype not in kinds or value.shape != wanted:
            came = f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            kind = " or ".join(str(each).removeprefix("torch.") for each in kinds)
            raise BadInput(f"{name}: {field} is {came}; it must be {kind} of shape {wanted}, a value for each point")
    _refuse_out_of_range(name, edit)
    if edit.new is not None:
        expect_kind(f"{name}: new", edit.new, NewPoints)
        expect_tensor(f"{name}: new.parent", edit.new.parent, ("int64",), ("M",))
        if len(edit.new) and not 0 <= int(edit.new.parent.min()) <= int(edit.new.parent.max()) < count:
            raise BadInput(
                f"{name}: new.parent names points that are not there; they are counted from 0 to {count - 1}"
            )
        expect_rows(f"{name}: new", edit.new.params, columns, len(edit.new))
    return edit


def _refuse_out_of_range(name: str, edit: Edit) -> None:
    """BadInput for values that no point can have; of points that are dropped anyway none is looked at."""
    most = edit.max_opacity
    if most is not None and not (isinstance(most, (int, float)) and 0 < most < 1):
        raise BadInput(f"{name}: max_opacity is {str(most)[:40]}; it must be a number between 0 and 1")
    left = None if edit.drop is None else ~edit.drop
    checks: tuple[tuple[str, str, Callable[[Tensor], Tensor]], ...] = (
        ("clone", "0 or more", lambda value: value >= 0),
        ("opacities", "between 0 and 1, or NaN", lambda value: value.isnan() | ((value > 0) & (value < 1))),
        ("scale_by", "finite and above 0", lambda value: (value > 0) & value.isfinite()),
    )
    for field, wanted, fits in checks:
        value = getattr(edit, field)
        if value is None or value.dtype == torch.bool:
            continue
        wrong = ~fits(value) if left is None else ~fits(value) & left
        if wrong.any():
            raise BadInput(f"{name}: {field} of point {int(wrong.nonzero()[0])} is {value[wrong][0]:g}; give {wanted}")


def expect_rows(where: str, given: Any, columns: Columns, count: int) -> None:
    """BadInput unless there are so many rows of each column: those of another number or width would be cut or repeated.

    Args:
        where: Begins messages.
        given: Raw parameters by name; the shared ones may be among them.
        columns: Of the points that are there, (N, ...) each.
        count: Rows.
    """
    expect_kind(where, given, dict)
    for name, column in columns.items():
        if name not in given:
            raise BadInput(f"{where}: there is no column {name}; the points have {', '.join(sorted(columns))}")
        kind = str(column.dtype).removeprefix("torch.")
        expect_tensor(f"{where}: {name}", given[name], (kind,), (count, *column.shape[1:]))


def withheld(edit: Edit, may: Tensor) -> Edit:
    """An edit that copies, splits and adds new points for no others than the points of a (N,) mask.

    Of a point that was to be copied or split and may not, the rest of the edit but for its removal is left out, too:
    such changes were to make up for its copies.
    """
    if edit.new is not None:
        edit = replace(edit, new=edit.new.take(may[edit.new.parent]))
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


def fitted(primitive: Primitive, points: Points) -> Points:
    """The points with the columns that the others determine (`Primitive.dependent`)."""
    with torch.no_grad():
        found = primitive.dependent(points.all_params())
    return points.with_params(found) if found else points


def observe(primitive: Primitive, points: Points, views: Sequence[View], near: float) -> Points:
    """The points with the columns that the others determine, and those that follow from the training cameras as these
    are now (`Primitive.observed`)."""
    points = fitted(primitive, points)
    with torch.no_grad():
        found = primitive.observed(points.all_params(), [view.camera for view in views], near)
    return points.with_params(found) if found else points


def merge(edits: Sequence[Edit | None]) -> Edit | None:
    """One edit from several: a dropped point is neither cloned nor split, a split one not cloned; None if none asks.

    Of the copies that several ask for the most are made; moves add up, factors of scales multiply, and of several
    opacities the lowest counts. New points of all are added; of several values of a parameter the last counts.
    """
    asked = [edit for edit in edits if edit is not None]
    if not asked:
        return None

    def given(name: str) -> list[Any]:
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
        scatter=most_of("scatter"),
        new=_together(new) if (new := given("new")) else None,
        values={name: value for each in given("values") for name, value in each.items()} or None,
    )


def _together(new: Sequence[NewPoints]) -> NewPoints:
    """The new points of all, in this order."""
    params = {name: torch.cat([each.params[name] for each in new]) for name in new[0].params}
    return NewPoints(params, torch.cat([each.parent for each in new]))


def _lowest(opacities: list[Tensor]) -> Tensor:
    """(N,) the lowest of several, NaN where all are."""
    found = torch.stack([torch.where(each.isnan(), torch.inf, each) for each in opacities]).amin(0)
    return torch.where(found.isinf(), torch.nan, found)


def _adjust(primitive: Primitive, points: Points, edit: Edit) -> None:
    """Move, dim and scale points, and forget their moments, where the edit asks for it."""
    if edit.move is not None:
        _put(points, primitive.moved(points.params, edit.move))
    if edit.opacities is not None:
        _put(points, primitive.with_opacities(points.params, edit.opacities))
    if edit.scale_by is not None:
        _put(points, primitive.scaled(points.params, edit.scale_by))
    if edit.values is not None:
        _give(points, edit.values)
    if edit.forget is None or not edit.forget.any():
        return
    kept = ~edit.forget
    for group in (points.exp_avg, points.exp_avg_sq):
        for name, value in group.items():
            group[name] = points.storage.held(value * kept.view(-1, *[1] * (value.dim() - 1)))


def _put(points: Points, params: Columns) -> set[str]:
    """Let points have other raw parameters where these are others; the names of those."""
    changed = {name for name, value in params.items() if value is not points.params[name]}
    points.params.update({name: points.storage.held(params[name]) for name in changed})
    return changed


def _scattered(
    primitive: Primitive, params: Columns, shared: Columns, which: Tensor, generator: torch.Generator
) -> Columns:
    """Raw parameters of points of which those of a mask lie at places drawn from their own Gaussians."""
    rows = which.nonzero()[:, 0]
    moved = primitive.scattered({name: value[rows] for name, value in params.items()} | shared, generator)
    return {name: value.index_copy(0, rows, moved[name]) for name, value in params.items()}


def _give(points: Points, values: Columns) -> None:
    """Let points have other raw values of some parameters, of points or shared."""
    known = points.all_params()
    for name, value in values.items():
        if name not in known or value.shape != known[name].shape:
            shape = tuple(known[name].shape) if name in known else "no such parameter"
            raise BadInput(f"Edit.values: {name!r} has shape {tuple(value.shape)}, and the points have {shape}")
        expect_tensor(
            f"Edit.values: {name!r}", value, (str(known[name].dtype).removeprefix("torch."),), tuple(value.shape)
        )
    points.shared.update({name: value for name, value in values.items() if name in points.shared})
    _put(points, {name: value for name, value in values.items() if name not in points.shared})


def _dim(primitive: Primitive, points: Points, most: float) -> None:
    """Let points have opacities of at most `most`; the optimiser starts anew for what that has changed."""
    opacities = primitive.activate(points.params | points.shared, 0).opacities.detach()
    wanted = torch.full_like(opacities, torch.nan, dtype=torch.float64).masked_fill(opacities > most, most)
    for name in _put(points, primitive.with_opacities(points.params, wanted)):
        for group in (points.exp_avg, points.exp_avg_sq):
            group[name] = points.storage.zeros(len(points), points.params[name])
