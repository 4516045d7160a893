"""What every rasterizer takes and gives: plain tensors, no autograd graph through the kernels.

Conventions, shared by `reference.py` (the definition of correct) and the native backends:

- Letters: N splats, H x W pixels, K = (degree + 1)^2 coefficients of spherical harmonics.
- Camera frame as in `scene.camera`; quaternions wxyz of any non-zero length; pixel (i, j) has its centre at
  (j + 0.5, i + 0.5). Lengths are local units: the scene extent is 1.
- Opacity times kernel gives alpha, at most ALPHA_MAX; below ALPHA_MIN it is skipped. A splat that would bring the
  transmittance T below T_MIN is not blended and ends the ray. Splats are ordered by the depth of their centre.
- The constants are the float32 roundings, in every precision, so that a float64 evaluation takes the same branches.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

ALPHA_MAX = float(np.float32(0.99))
ALPHA_MIN = float(np.float32(1 / 255))
T_MIN = float(np.float32(1e-4))
CUTOFF = math.sqrt(2 * math.log(255))
"""Sigmas at which a splat of opacity 1 falls to ALPHA_MIN."""

MAPS = ("color", "alpha", "depth", "median", "normal", "distortion")
"""Names in the order of `Maps`; the kernels make the first 2, the first 5 or all of them."""

STANDARD = ("means", "quats", "scales", "opacities", "sh0", "sh_rest")
"""Tensors that all splats have."""

DILATION = 0.3
"""Variance that 3DGS adds to the footprint of an ellipsoid, px^2."""

PRIMITIVE_KINDS = ("surfel", "gaussian")
"""What the rasterizers of surfkit draw: flat discs (2DGS) and ellipsoids (3DGS)."""

GEOMETRIES = ("axis", "plane", "ray", "solid")
"""How ellipsoids are evaluated; see `Splats.geometry`."""

ALONG_RAYS = ("ray", "solid")
"""Geometries that evaluate ellipsoids in space, along each ray, and not their footprints."""


@dataclass(frozen=True)
class Splats:
    """N splats in activated values.

    Attributes:
        kind: "surfel" is a flat disc (2DGS), "gaussian" an ellipsoid (3DGS); primitives that draw themselves have more.
        means: (N, 3) world.
        quats: (N, 4) wxyz.
        scales: (N, 2) for surfels, (N, 3) for gaussians; local units, positive.
        opacities: (N,) in [0, 1].
        sh0: (N, 1, 3) spherical harmonics of degree 0.
        sh_rest: (N, K - 1, 3) those of higher degrees, K in {1, 4, 9, 16}; none, if not given. They are apart, as they
            are trained at rates of their own: to join them would copy three quarters of a point in each step.
        antialias: Gaussians only: lower the opacity by what the dilation adds to the footprint.
        dilation: Gaussians only: variance that is added to the footprint, px^2.
        geometry: Gaussians only. "axis": footprint by EWA splatting, the normal is the shortest axis. "plane": the same
            footprint, the normal is that of the plane that gives the depth (RaDe-GS). "ray": density and depth at the
            largest density along each ray, without EWA and dilation, the normal is that of the ellipsoid there (GOF).
            "solid": the same, and the median depth is that of stochastic solids (GGGS); see `Maps.median`.
        extra: Further tensors (N, ...) by name, for primitives that draw themselves.
        shared: Further tensors that belong to no splat.
    """

    kind: str
    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    sh_rest: Tensor = None  # type: ignore[assignment]  # then made in __post_init__
    antialias: bool = False
    dilation: float = DILATION
    geometry: str = "axis"
    extra: Mapping[str, Tensor] = field(default_factory=dict)
    shared: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sh_rest is None:
            object.__setattr__(self, "sh_rest", self.sh0.new_zeros(len(self.sh0), 0, 3))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh(self) -> Tensor:
        """(N, K, 3), all harmonics; a copy."""
        return torch.cat([self.sh0, self.sh_rest], 1)

    def with_colors(self, sh0: Tensor) -> Splats:
        """The same with harmonics of degree 0 alone, (N, 1, 3)."""
        return replace(self, sh0=sh0, sh_rest=sh0.new_zeros(len(sh0), 0, 3))

    def and_then(self, others: Splats) -> Splats:
        """These and others of the same kind, in this order."""
        return self._with(lambda value, other: torch.cat([value, other]), others)

    def detached(self) -> Splats:
        """The same values without an autograd graph."""
        shared = {name: value.detach() for name, value in self.shared.items()}
        return replace(self._with(lambda value, _: value.detach(), self), shared=shared)

    def to(self, device: torch.device) -> Splats:
        """The same on a device."""
        return self.with_named({name: value.to(device) for name, value in self.named().items()})

    def first(self, count: int) -> Splats:
        """The first so many of them."""
        return self._with(lambda value, _: value[:count], self)

    def take(self, rows: Tensor) -> Splats:
        """Those of a mask (N,) bool, or of indices (K,) int64."""
        return self._with(lambda value, _: value[rows], self)

    def tensors(self) -> dict[str, Tensor]:
        """The standard tensors by name, (N, ...) each, in the order of the fields."""
        return {name: getattr(self, name) for name in STANDARD}

    def named(self) -> dict[str, Tensor]:
        """All tensors by name: the standard ones and those of `extra`, (N, ...), then those of `shared`."""
        return self.tensors() | dict(self.extra) | dict(self.shared)

    def with_named(self, tensors: Mapping[str, Tensor]) -> Splats:
        """The same kind of M splats with other tensors, (M, ...) each, by the names of `named`."""
        standard: dict[str, Any] = {name: tensors[name] for name in STANDARD}
        extra, shared = ({name: tensors[name] for name in group} for group in (self.extra, self.shared))
        return replace(self, **standard, extra=extra, shared=shared)

    def _with(self, change: Callable[[Tensor, Tensor], Tensor], others: Splats) -> Splats:
        """The same with each tensor of (N, ...) changed."""
        rest = others.tensors()
        standard: dict[str, Any] = {name: change(value, rest[name]) for name, value in self.tensors().items()}
        return replace(
            self, **standard, extra={name: change(value, others.extra[name]) for name, value in self.extra.items()}
        )


@dataclass(frozen=True)
class Maps:
    """Images of a view, or the cotangents of such images; None where not asked for.

    With weights w_i = alpha_i T_i and depths z_i along the ray (camera z, not distance):

    Attributes:
        color: (3, H, W) sum of w_i c_i over black.
        alpha: (H, W) sum of w_i, which is 1 - T at the end.
        depth: (H, W) sum of w_i z_i; divide by alpha for the expected depth.
        median: (H, W) depth of the last splat met while T > 0.5; 0 where T never falls to 0.5. Of geometry "solid": the
            depth t where T(t) of stochastic solids is 0.5 (GGGS, eq. 10 to 12), which moves with all splats of the ray
            (eq. 13); 0 also where it is not within 40 % of that depth. Where T falls by less than a factor e over the
            whole way at the rate it has there, it has no gradient.
        normal: (3, H, W) sum of w_i n_i, camera frame, n_i facing the camera.
        distortion: (H, W) sum over pairs j < i of w_i w_j (1 / z_i - 1 / z_j)^2.
    """

    color: Tensor | None = None
    alpha: Tensor | None = None
    depth: Tensor | None = None
    median: Tensor | None = None
    normal: Tensor | None = None
    distortion: Tensor | None = None

    def present(self) -> dict[str, Tensor]:
        """The maps that are there by name, (C, H, W) or (H, W)."""
        return {f.name: v for f in fields(self) if (v := getattr(self, f.name)) is not None}

    def need(self, name: str) -> Tensor:
        """The map of this name, (3, H, W) or (H, W); ValueError if it was not asked for."""
        found: Tensor | None = getattr(self, name)
        if found is None:
            raise ValueError(f"the map {name!r} was not drawn; ask for it")
        return found

    def expected_depth(self) -> Tensor:
        """(H, W) depth / alpha; 0 where alpha is 0."""
        alpha = self.need("alpha")
        return torch.where(alpha > 0, self.need("depth") / alpha.clamp_min(1e-10), 0.0)


@dataclass(frozen=True)
class Derived:
    """The M splats that were made of others for one view, such as Gaussians from anchors, and their signal.

    Attributes:
        splats: M of them, detached.
        owner: (M,) int64, the splat that each was made of.
        seen: (M,) bool, as `Render.seen`.
        signal: (M, 2) as `Gradients.signal`.
        chosen: (M, 2) as `Gradients.chosen`.
        grad_norm: (M,) length of the densification signal, as `Step.grad_norm`; None before a trainer has chosen it.
    """

    splats: Splats
    owner: Tensor
    seen: Tensor
    signal: Tensor
    chosen: Tensor | None = None
    grad_norm: Tensor | None = None

    def combined(self, combine: Callable[[Tensor, Tensor], Tensor]) -> Derived:
        """The same with `grad_norm` set by a function of the chosen and the total signal, (M, 2) each, as
        `Signal.combine`."""
        chosen = self.signal if self.chosen is None else self.chosen
        return replace(self, grad_norm=combine(chosen, self.signal).norm(dim=-1))

    def first(self, count: int | None) -> Derived:
        """Those that were made of the first `count` splats; all for None."""
        if count is None:
            return self
        kept = self.owner < count
        chosen = None if self.chosen is None else self.chosen[kept]
        return Derived(self.splats.take(kept), self.owner[kept], self.seen[kept], self.signal[kept], chosen)


@dataclass(frozen=True)
class Gradients:
    """dL/d(splats) of one backward pass, and the densification signal.

    The signal is the screen-space positional gradient in NDC units (pixels x half the image size), as the published
    thresholds expect. Surfels: (dL/dT_u.z, dL/dT_v.z) T_w.z (2DGS), the low-pass centre included.

    Attributes:
        means, quats, scales, opacities, sh0, sh_rest: Shapes of `Splats`.
        signal: (N, 2) of the total loss.
        chosen: (N, 2) of the chosen losses, or the sum of the sizes of its shares of the pixels, of the depth of solids
            apart from those of the other maps; None if no second cotangent was given.
        extra: By the `extra` and `shared` tensors of the splats that have an influence, by name.
        derived: The splats that were drawn in place of these, and their signal; None where these were drawn.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    sh_rest: Tensor
    signal: Tensor
    chosen: Tensor | None = None
    extra: Mapping[str, Tensor] = field(default_factory=dict)
    derived: Derived | None = None

    def tensors(self) -> dict[str, Tensor]:
        """The standard gradients by name, (N, ...) each, in the order of `Splats.tensors`."""
        return {name: getattr(self, name) for name in STANDARD}

    def named(self) -> dict[str, Tensor]:
        """All gradients by name, (N, ...) each; of what is shared, the shape of the parameter."""
        return self.tensors() | dict(self.extra)


class Render(ABC):
    """One rendered view, and the way back.

    Attributes:
        maps: Detached images; color and alpha always, the rest when geometry was asked for. Some rasterizers draw them
            when they are first looked at: what is seen can be had for less.
        seen: (N,) bool, the splat may touch a pixel.
        radii: (N,) pixels, half the larger side of the box around the splat's footprint; 0 where not seen.
    """

    maps: Maps
    seen: Tensor
    radii: Tensor

    @abstractmethod
    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        """Gradients from cotangents of the maps, in one pass; the signal of `chosen` comes beside them.

        Args:
            total: Of all losses.
            chosen: Of the losses that drive densification.
            absolute: Sum the absolute values of the pixels' shares of that signal, component by component (AbsGS).
            rows: Only of the first so many splats, of all if None; the others still hide what is behind them.
        """
