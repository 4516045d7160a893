"""Refuse splats that no rasterizer can draw."""

from __future__ import annotations

import math

import torch

from surfkit.core.check import BadInput
from surfkit.raster.api import ALONG_RAYS, GEOMETRIES, PRIMITIVE_KINDS, Splats


def validate(splats: Splats, values: bool = True) -> None:
    """Check shapes and, with `values`, that numbers are finite, scales positive and quaternions not zero.

    Raises:
        BadInput: Naming the tensor, the first wrong row and what is allowed.
    """
    if splats.kind not in PRIMITIVE_KINDS:
        raise BadInput(
            f"splats of kind {splats.kind!r}: the rasterizers draw {'s and '.join(PRIMITIVE_KINDS)}s; the primitive "
            f"needs a "
            "`render` of its own, a `contribution` for blocks and trimming, and an `opacity_before` for mesh:tetra"
        )
    if splats.geometry not in GEOMETRIES or (splats.kind == "surfel" and splats.geometry != "axis"):
        raise BadInput(
            f"splats.geometry: {splats.geometry!r} of kind {splats.kind!r}; gaussians have {', '.join(GEOMETRIES)}, "
            "surfels only axis"
        )
    if splats.geometry in ALONG_RAYS and splats.antialias:
        raise BadInput(
            f"splats.antialias: gaussians of geometry {splats.geometry!r} have no dilation to make up for; leave it off"
        )
    count = len(splats)
    columns = 2 if splats.kind == "surfel" else 3
    wanted: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "scales": (columns,), "opacities": ()}
    wanted["sh0"] = (1, 3)
    for name, tensor in splats.tensors().items():
        shape = tuple(tensor.shape)
        if name == "sh_rest":
            if len(shape) != 3 or shape[0] != count or shape[1] not in (0, 3, 8, 15) or shape[2] != 3:
                raise BadInput(f"splats.sh_rest: shape {shape}; it must be ({count}, 0, 3, 8 or 15, 3)")
        elif shape != (count, *wanted[name]):
            raise BadInput(f"splats.{name}: shape {shape}; a {splats.kind} needs {(count, *wanted[name])}")
    if not values:
        return
    for name, tensor in splats.tensors().items():
        rows = tensor.detach().reshape(count, math.prod(tensor.shape[1:]))
        _refuse(~torch.isfinite(rows).all(1), name, "not finite")
        if name == "scales":
            _refuse(~(rows > 0).all(1), name, "not positive")
        if name == "quats":
            _refuse(~(rows != 0).any(1), name, "zero, which is no rotation")


def _refuse(bad: torch.Tensor, name: str, what: str) -> None:
    if bad.any():
        raise BadInput(
            f"splats.{name}: {int(bad.sum())} of {len(bad)} rows are {what}; the first is row {int(bad.int().argmax())}"
        )
