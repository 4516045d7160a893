"""The check of rasterizers, against the reference in torch, which is the definition of correct."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from surfkit.core.check import BadInput
from surfkit.raster.api import Gradients, Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.reference import Reference
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.scene.camera import Camera
from surfkit.testing.equality import assert_same, unchanged
from surfkit.testing.inputs import splats

NEAR_PLANE = 0.01
BOX_SPLATS = 4
MAX_VALUE_ERROR = 1e-3
"""Largest error of a value, as a share of the largest one of its map if that is above 1."""
MAX_ODD_SHARE = 0.02
"""Share of the values that may be off: which splats a pixel skips may hang on the last digit."""
MAX_GRADIENT_ERROR = 0.02
"""Largest error of the gradients of a tensor, as a share of their norm."""


def check_rasterizer(rasterizer: Rasterizer) -> None:
    """A rasterizer draws what the reference draws, of discs and ellipsoids, with its gradients, contributions and
    opacities; it tells what is in view, repeats itself, changes nothing it was given, draws no splats as black, and
    refuses NaN.

    Args:
        rasterizer: To check.

    Raises:
        BadInput: It cannot run on this machine.
    """
    name = type(rasterizer).__name__
    if why := rasterizer.missing():
        raise BadInput(f"{name}: {why}")
    assert rasterizer.title(), f"{name}.title is empty; it is what run.json calls the rasterizer"
    camera, reference = _camera(), Reference()
    for kind in ("surfel", "gaussian"):
        given = splats(kind, 30)
        with unchanged(f"{name}.render", splats=given, camera=camera):
            found, true = (each.render(given, camera, NEAR_PLANE) for each in (rasterizer, reference))
        _check_maps(f"{name} of {kind}s", found, true)
        total = _cotangents(true.maps)
        grads, wanted = found.backward(total), true.backward(total)
        _check_gradients(f"{name} of {kind}s", grads, wanted)
        again = rasterizer.render(given, camera, NEAR_PLANE)
        for what, one, two in (("render", found.maps, again.maps), ("backward", grads, again.backward(total))):
            assert_same(f"{name}.{what}", one, two, "sum in a fixed order")
        _check_measures(f"{name} of {kind}s", rasterizer, reference, given)
        _check_in_view(f"{name} of {kind}s", rasterizer, given, found)
        _check_refusal(name, rasterizer, given)
        color = rasterizer.render(given.first(0), camera, NEAR_PLANE).maps.color
        assert not torch.as_tensor(color).any(), f"{name} draws something where there are no {kind}s"


def _check_in_view(name: str, rasterizer: Rasterizer, given: Splats, drawn: Render) -> None:
    """What is drawn is in view, and what is in view is in a box in view: else steps would leave points out."""
    in_view = torch.as_tensor(rasterizer.in_view(given, _camera(), NEAR_PLANE)).cpu()
    lost = int((drawn.seen.cpu() & ~in_view).sum())
    assert not lost, f"{name}: {lost} splats that are drawn are not in `in_view`"
    shown = rasterizer.boxes_in_view(SplatBoxes.of(given, BOX_SPLATS), _camera(), NEAR_PLANE)
    if shown is not None:
        of_boxes = torch.as_tensor(shown).cpu().repeat_interleave(BOX_SPLATS)[: len(given)]
        lost = int((in_view & ~of_boxes).sum())
        assert not lost, f"{name}: {lost} splats of `in_view` are in boxes that are not in `boxes_in_view`"


def _camera() -> Camera:
    """Before the unit cube, a little aside."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-0.45, -0.55, 0.8])
    return Camera(pose, 40.0, 41.0, 21.0, 15.0, 40, 30)


def _cotangents(maps: Maps) -> Maps:
    draw = torch.Generator().manual_seed(0)
    shapes = {key: getattr(maps, key).shape for key in ("color", "alpha", "depth", "normal")}
    return Maps(**{key: torch.randn(shape, generator=draw) for key, shape in shapes.items()})


def _check_maps(name: str, found: Render, true: Render) -> None:
    wanted = true.maps.present()
    lacking = sorted(set(wanted) - set(found.maps.present()))
    assert not lacking, f"{name}: the map {lacking[0]!r} is not there"
    for key, value in wanted.items():
        got = getattr(found.maps, key)
        assert got.shape == value.shape, f"{name}: {key!r} has shape {tuple(got.shape)}, not {tuple(value.shape)}"
        _check_close(f"{name}: {key!r}", got, value)
    shape = true.seen.shape
    assert found.seen.shape == found.radii.shape == shape, f"{name}: `seen` and `radii` are not one for each splat"
    assert not found.radii[~found.seen].any(), f"{name}: `radii` are not 0 where the splat is not seen"


def _check_close(what: str, got: Any, wanted: Any, off: float = MAX_VALUE_ERROR) -> None:
    got, wanted = got.double(), wanted.double()
    assert (got.isnan() == wanted.isnan()).all(), f"{what}: NaN is not where the reference has it"
    size = max(1.0, float(wanted.nan_to_num().abs().max())) if wanted.numel() else 1.0
    share = float(((got - wanted).nan_to_num().abs() > off * size).double().mean())
    assert torch.isfinite(got.nan_to_num()).all() and share <= MAX_ODD_SHARE, (
        f"{what}: {share:.0%} of the values are not those of the reference"
    )


def _check_gradients(name: str, found: Gradients, true: Gradients) -> None:
    for key, value in {**true.tensors(), "signal": true.signal}.items():
        got = getattr(found, key) if key == "signal" else found.tensors()[key]
        assert got.shape == value.shape, f"{name}: the gradient of {key!r} has shape {tuple(got.shape)}"
        error = float((got - value).norm() / value.norm().clamp_min(1e-9))
        assert error <= MAX_GRADIENT_ERROR, f"{name}: the gradient of {key!r} is off by {error:.0%} of its norm"


def _check_measures(name: str, rasterizer: Rasterizer, reference: Rasterizer, given: Splats) -> None:
    camera = _camera()
    pairs = [each.contribution(given, camera, NEAR_PLANE, 0.5, 0.5) for each in (rasterizer, reference)]
    for what, got, wanted in zip(("sum", "count"), *pairs, strict=True):
        _check_close(f"{name}: the {what} of contribution", got, wanted, off=0.01)
    got, wanted = _leading(rasterizer, given), reference.leading(given, camera, NEAR_PLANE)
    if got is not None:
        _check_close(f"{name}: leading", got, wanted, off=0.01)
    missed = int(((pairs[1][1] > 0) & ~rasterizer.render(given, camera, NEAR_PLANE).seen).sum())
    assert not missed, f"{name}: {missed} splats are blended into pixels, but not `seen`"
    places = torch.rand(200, 3, generator=torch.Generator().manual_seed(1))
    got, wanted = (each.opacity_before(given, camera, NEAR_PLANE, places) for each in (rasterizer, reference))
    _check_close(f"{name}: opacity_before", got, wanted)


def _leading(rasterizer: Rasterizer, given: Splats) -> torch.Tensor | None:
    """`Rasterizer.leading` of one that has it."""
    if type(rasterizer).leading is Rasterizer.leading:
        return None
    return rasterizer.leading(given, _camera(), NEAR_PLANE)


def _check_refusal(name: str, rasterizer: Rasterizer, given: Splats) -> None:
    means = given.means.clone()
    means[3, 1] = float("nan")
    try:
        rasterizer.render(replace(given, means=means), _camera(), NEAR_PLANE)
    except BadInput:
        return
    raise AssertionError(f"{name} draws a splat at NaN; raise BadInput (see `surfkit.raster.validate`)")
