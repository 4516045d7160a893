"""Gradients between losses, maps, splats and raw parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect, read_only
from surfkit.densify.base import Signal
from surfkit.losses.base import Loss, Regularizer, RegularizerInput, Target, ignoring
from surfkit.primitives.points import Columns
from surfkit.raster.api import Gradients, Maps, Splats
from surfkit.train.image_appearance import ImageAppearance
from surfkit.train.stage import Stage


def gradient(
    losses: list[Tensor], leaves: Columns, appearance: ImageAppearance | None = None, shared: bool = False
) -> Maps:
    """d(sum of losses)/d(maps), shapes of `Maps`; None for a map without influence, but colour is always there.

    Args:
        losses: Scalars.
        leaves: The maps by name, (C, H, W) or (H, W).
        appearance: Is given its own gradient; both come from one pass, as a network on the way costs much of it.
        shared: Other losses have part of their graph in common with these, and come later.
    """
    grads: Sequence[Tensor | None] = [None] * len(leaves)
    if losses:
        by = [*leaves.values(), *(appearance.leaves if appearance is not None else [])]
        grads = torch.autograd.grad(reduce(torch.add, losses), by, allow_unused=True, retain_graph=shared)
        if appearance is not None:
            appearance.add(grads[len(leaves) :])
    found = Maps(**dict(zip(leaves, grads[: len(leaves)], strict=True)))
    return found if found.color is not None else replace(found, color=torch.zeros_like(leaves["color"]))


def added(a: Maps, b: Maps) -> Maps:
    """The sum of two cotangents."""
    sums = a.present()
    for name, value in b.present().items():
        sums[name] = sums[name] + value if name in sums else value
    return Maps(**sums)


@torch.no_grad()
def without_transients(
    stage: Stage, index: int, maps: Maps, target: Target, appearance: ImageAppearance | None
) -> Target:
    """The target of step `index`, whose mask also covers what passes; all terms and statistics see this one."""
    if stage.transients is None:
        return target
    color = maps.need("color")
    shown = color if appearance is None else appearance.shown(color)
    kept = stage.transients.kept(shown, target, index, stage.steps)
    if kept is None:
        return target
    return replace(target, mask=kept if target.mask is None else target.mask & kept)


def loss_gradients(
    losses: Mapping[str, Loss],
    signal: Signal,
    active: Mapping[str, float],
    maps: Maps,
    target: Target,
    appearance: ImageAppearance | None,
) -> tuple[dict[str, float], Maps, Maps | None]:
    """The weighted losses; their gradient by the maps, and that of those that `Signal.terms` names.

    The appearance is given its own gradient.
    """
    terms = signal.terms
    leaves = {name: value.detach().requires_grad_() for name, value in maps.present().items()}
    leafy = Maps(**leaves)
    shown = leafy if appearance is None else replace(leafy, color=appearance.shown(leafy.need("color")))
    changed = plain = ignoring(shown, target)
    if appearance is not None and appearance.model.spares_structure:
        plain = ignoring(leafy, target)  # hidden pixels of the photograph are then those of the scene as it is

    def value_of(name: str) -> Tensor:
        given = plain if losses[name].of_structure else changed
        with read_only(f"losses.{name}", {"target.photo": given[1].photo}):
            return _one_number(name, losses[name](*given))

    values = {name: weight * value_of(name) for name, weight in active.items()}
    numbers = as_numbers(values)
    if terms is None:
        total = gradient(list(values.values()), leaves, appearance)
        return numbers, total, total if signal.absolute else None
    shared = appearance is not None or target.mask is not None  # what shows or hides pixels is before all losses
    chosen = gradient([value for name, value in values.items() if name in terms], leaves, appearance, shared)
    others = gradient([value for name, value in values.items() if name not in terms], leaves, appearance)
    return numbers, added(chosen, others), chosen


def _one_number(name: str, value: Any) -> Tensor:
    """What a loss gives, or BadInput that names the loss: what comes later could not tell which one it was."""
    if not isinstance(value, Tensor) or value.numel() != 1:
        expect(f"losses.{name}", value, ())
    if not value.requires_grad and value.item():  # 0 is what a loss may say of a view that has no data for it
        raise BadInput(
            f"losses.{name}: its value {value.item():.4g} does not depend on what is drawn, so nothing is learnt from "
            "it; compute it from the maps without detach(), item() or numpy(), or give 0"
        )
    return value


def regularizer_terms(
    regularizers: Mapping[str, Regularizer], splats: Splats, given: RegularizerInput, parts: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The weighted terms on the points that count in a step, scalars by key, with their graph to the splats; `parts` of
    them are known already (`terms_with_maps`)."""
    weights = {name: term.weight_at(given.index, given.steps) for name, term in regularizers.items()}
    terms = {name: weight * regularizers[name].in_step(splats, given) for name, weight in weights.items() if weight > 0}
    return terms | {name: terms[name] + value for name, value in parts.items()}


def terms_with_maps(
    regularizers: Mapping[str, Regularizer], splats: Splats, given: RegularizerInput, total: Maps
) -> tuple[dict[str, Tensor], Maps]:
    """What `Regularizer.with_maps` gives in a step, weighted scalars by key, with the graph to the splats; and the
    `total` gradient of all losses by the maps, (C, H, W) or (H, W) each, with theirs."""
    leaves = {name: value.detach().requires_grad_() for name, value in given.maps.present().items()}
    given, found = replace(given, maps=Maps(**leaves)), {}
    for name, term in regularizers.items():
        weight = term.weight_at(given.index, given.steps)
        if weight > 0 and (value := term.with_maps(splats, given)) is not None:
            found[name] = weight * value
    return found, added(total, gradient(list(found.values()), leaves, shared=True)) if found else total


def as_numbers(values: Mapping[str, Tensor]) -> dict[str, float]:
    """Scalars as Python numbers; the host waits for the device once."""
    if not values:
        return {}
    together = torch.stack([value.detach().double().reshape(()) for value in values.values()])
    return dict(zip(values, together.tolist(), strict=True))


def pulled(
    shape: Splats, gradients: Gradients, leaves: Columns, terms: Sequence[Tensor] = (), again: bool = False
) -> Columns:
    """Gradients by the raw parameters, (N, ...) each, from those by the splats and from terms on the splats, scalars.

    A parameter without influence is left out. Of one that is a part of a larger tensor of the splats the gradient may
    be a part of that tensor's, whose rows do not follow each other. `again` keeps the graph, to pull other gradients.
    """
    splats, grads = shape.named(), gradients.named()
    names = [name for name, value in splats.items() if value.requires_grad and name in grads]
    known = _KnownGradient.apply([grads[name] for name in names], *(splats[name] for name in names))  # type: ignore[no-untyped-call]
    raw = torch.autograd.grad([known, *terms], list(leaves.values()), allow_unused=True, retain_graph=again)
    return {name: grad for name, grad in zip(leaves, raw, strict=True) if grad is not None}


class _KnownGradient(torch.autograd.Function):
    """A scalar whose gradients by some tensors are known already.

    To give them to `torch.autograd.grad` as `grad_outputs` comes to the same, but torch then imports sympy, which takes
    longer than the first steps.
    """

    @staticmethod
    def forward(ctx: Any, grads: list[Tensor], *values: Tensor) -> Tensor:
        ctx.grads = grads
        return values[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, _: Tensor) -> tuple[Tensor | None, ...]:
        return None, *ctx.grads
