"""Scenes with what the reference makes of them in float64, and how far a rasterizer may be from that."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from surfkit.raster.api import STANDARD, Gradients, Maps, Render, Splats
from surfkit.raster.reference import Reference, draw
from surfkit.scene.camera import Camera

from .scenes import NEAR, Draw, double, make

FORWARD, BACKWARD = 1e-5, 1e-4
THIN_SOLIDS = 2e-3
"""Gradients of the depth of solids: of very thin ones, what a float of that depth loses counts."""
ZERO = 1e-9


@dataclass(frozen=True)
class Case:
    """A scene, what the reference makes of it, and random cotangents that are 0 at pixels near a threshold; and how far
    gradients may be from it."""

    splats: Splats
    view: Camera
    clear: Tensor
    true: Render
    cotangents: dict[str, Tensor]
    allowed: float = BACKWARD


@cache
def case(name: str, kind: str, degree: int | None = None) -> Case:
    shown, view = make(name, kind, degree)
    exact = double(shown)
    with torch.no_grad():
        clear = ~draw(exact, view, NEAR).near_threshold
    true = Reference().render(exact, view, NEAR)
    draws = Draw(11)
    maps = true.maps.present()
    cotangents = {key: (draws.normal(*value.shape) * clear).float() for key, value in maps.items()}
    return Case(
        shown,
        view,
        clear,
        true,
        cotangents,
        THIN_SOLIDS if kind == "solid" and name in ("needle", "tiny") else BACKWARD,
    )


@cache
def true_gradients(name: str, kind: str) -> dict[str, Gradients]:
    """What the reference gives for the cotangent of each map alone."""
    c = case(name, kind)
    return {key: c.true.backward(Maps(**{key: value})) for key, value in c.cotangents.items()}


def added(parts: Iterable[Gradients]) -> Gradients:
    """The gradients for several cotangents at once, as they are linear in these."""
    parts = list(parts)
    return Gradients(**{name: sum(getattr(part, name) for part in parts) for name in (*STANDARD, "signal")})


def different_maps(found: Maps, true: Maps, clear: Tensor) -> dict[str, float]:
    """Maps that differ by more than FORWARD and by how much; of the largest value where that is more than 1.

    Depth has the unit of z and distortion that of 1 / z^2, here up to 400.
    """
    errors = {}
    for key, value in true.present().items():
        size = max(1.0, value.abs().max().item()) if key in ("depth", "distortion") else 1.0
        error = ((getattr(found, key).double() - value.double()).abs() * clear).max().item() / size
        if not error <= FORWARD:
            errors[key] = error
    return errors


def different_gradients(found: Gradients, true: Gradients, share: float = BACKWARD) -> dict[str, float]:
    """Gradients that differ by more than a share of their norm, and by how much.

    A gradient may be 0 for every splat: a disc's scale does not move the plane that gives the median. There two sums
    cancel that are as large as the gradient of the means, a length too, times the place on the disc in sigmas: it is
    held against that gradient. The scales of a disc below a pixel act through perspective only, and nearly cancel
    too, hence one more share.
    """
    errors = {}
    means = true.means.norm().item()
    parts = {"signal": true.signal, "chosen": true.chosen}
    for key, value in {**true.tensors(), **parts}.items():
        if value is None:
            continue
        size, made = value.norm().item(), getattr(found, key).double()
        allowed = share * means if key == "scales" and size < ZERO * means else share * size
        if key == "scales":
            allowed += 1e-6 * means
        error = (made - value.double()).norm().item()
        if not error <= allowed:
            errors[key] = error / max(size, 1e-30)
    return errors
