"""Splats as files hold them: one table, or a tree of tiles with levels of detail."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect
from surfkit.io.splats.file_axes import PLY_AXES, FileAxes
from surfkit.scene.scene import Frame

THINNESS = 1e-3
"""Thickness of a surfel where ellipsoids are needed, as a share of its smaller radius: flat in every viewer, and free
of units."""
SURFEL_SCALE_RATIO = 10.0
"""Where a file does not say so, splats are surfels only if their third scale is this many times smaller than the
others."""

MAX_SPLAT_VALUE = 1e18
"""No value of a splat lies further from 0: squares of larger ones have no place in float32."""
OPAQUE_LOGIT = 18.0
"""The logit of an opacity that is 1 in float32."""
SPLAT_COLUMNS = ("means", "quats", "log_scales", "opacity_logits", "sh0", "sh_rest")
"""Tensors of a table, a row for each splat."""


Kind = Literal["surfel", "gaussian"]
"""A flat disc (2DGS) or an ellipsoid (3DGS)."""


@dataclass(frozen=True)
class SplatTable:
    """N splats in raw values, as files hold them.

    Attributes:
        kind: "surfel" is a flat disc (2DGS), "gaussian" an ellipsoid (3DGS).
        means: (N, 3) positions.
        quats: (N, 4) wxyz of any length.
        log_scales: (N, 2) for surfels, (N, 3) for gaussians; natural logarithm of lengths.
        opacity_logits: (N,).
        sh0: (N, 3) coefficients of degree 0.
        sh_rest: (N, K - 1, 3) coefficients of degrees 1 to 3, K in {1, 4, 9, 16}.
        antialias: Gaussians only: to be drawn dimmed by what the blur of the rasterizer adds to them (Mip-Splatting).
        axes: Of the numbers in the file that the splats were read from; the reader has turned them to PLY_AXES.
        is_filtered: Whether a filter of the file was applied to them (Mip-Splatting, Gaussian Opacity Fields) that does
            not say how they are to be drawn.
    """

    kind: Kind
    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh0: Tensor
    sh_rest: Tensor
    antialias: bool = False
    axes: FileAxes = FileAxes(PLY_AXES)
    is_filtered: bool = False

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise BadInput(f"kind is {self.kind!r}; splats are of the kind {' or '.join(get_args(Kind))}")
        for name in SPLAT_COLUMNS:
            if not isinstance(column := getattr(self, name), Tensor):
                raise BadInput(f"{name}: expected a tensor, got {type(column).__name__}; torch.as_tensor makes one")
        sizes = expect("means", self.means, ("N", 3))
        expect("quats", self.quats, ("N", 4), sizes)
        expect("log_scales", self.log_scales, ("N", 2 if self.kind == "surfel" else 3), sizes)
        expect("opacity_logits", self.opacity_logits, ("N",), sizes)
        expect("sh0", self.sh0, ("N", 3), sizes)
        rest = expect("sh_rest", self.sh_rest, ("N", "K - 1", 3), sizes)["K - 1"]
        if rest not in (0, 3, 8, 15):
            raise BadInput(f"sh_rest: {rest} coefficients; degrees 0 to 3 have 0, 3, 8 or 15")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacities(self) -> Tensor:
        """(N,) in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def scales(self) -> Tensor:
        """(N, 2) or (N, 3) standard deviations along the axes."""
        return self.log_scales.exp()

    @property
    def sh_degree(self) -> int:
        """Highest degree of the spherical harmonics."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    def in_input_frame(self, frame: Frame) -> SplatTable:
        """The same splats in the frame of the input; positions in float64. The frame does not turn, so nor does SH."""
        means = torch.from_numpy(frame.to_input(self.means.detach().cpu().numpy()))
        return replace(self, means=means, log_scales=self.log_scales - math.log(frame.scale))

    def ellipsoid_log_scales(self) -> Tensor:
        """(N, 3) scales for programs that know ellipsoids only: surfels get a third one, THINNESS x the smaller one."""
        if self.log_scales.shape[1] == 3:
            return self.log_scales
        return torch.cat([self.log_scales, self.log_scales.amin(1, keepdim=True) + math.log(THINNESS)], dim=1)

    def as_surfels(self) -> SplatTable:
        """The same ellipsoids as surfels, without their third scale."""
        return self if self.kind == "surfel" else replace(self, kind="surfel", log_scales=self.log_scales[:, :2])

    def as_surfels_if_thin(self, rounding: float, least: float = -math.inf) -> SplatTable:
        """As surfels, if all are as flat as `ellipsoid_log_scales` makes them, or flatter; ellipsoids otherwise.

        Args:
            rounding: Largest difference between a scale in the file and what was written, in logarithms.
            least: Smallest logarithm that the file has a place for; thinner splats have it.
        """
        if not len(self) or self.kind == "surfel":
            return self
        smaller, third = self.log_scales[:, :2].amin(1), self.log_scales[:, 2]
        expected = (smaller + math.log(THINNESS)).clamp_min(least)
        thin = (third - expected).max() <= 2 * rounding and (smaller - third).median() >= math.log(SURFEL_SCALE_RATIO)
        return self.as_surfels() if thin else self

    def without_infinities(self) -> SplatTable:
        """The same splats, where some programs write infinite logits for opacities of 0 and 1, and infinitely thin
        scales, with finite ones that draw the same."""
        logits, scales = self.opacity_logits, self.log_scales
        smallest = torch.where(scales.isfinite(), scales, math.inf).amin(1, keepdim=True) + math.log(THINNESS)
        return replace(
            self,
            opacity_logits=torch.where(logits.isinf(), logits.sign() * OPAQUE_LOGIT, logits),
            log_scales=torch.where(scales.isneginf(), smallest, scales),
        )

    def file_means(self, frame: Frame | None) -> Tensor:
        """(N, 3) positions for a file of few bits: float64 without the shift of the frame, where there is one."""
        means = self.means.detach().cpu()
        if frame is None or not any(frame.shift):
            return means
        return means.double() - torch.tensor(frame.shift, dtype=torch.float64)

    def refuse_unsound(self, where: object) -> None:
        """BadInput if a value is NaN, Inf or beyond LARGEST; `where` is the file that the message names."""
        for name in SPLAT_COLUMNS:
            column = getattr(self, name)
            if not column.numel():
                continue
            least, most = torch.aminmax(column)  # NaN wins, and no mask of the whole column is made
            if not (-MAX_SPLAT_VALUE <= least and most <= MAX_SPLAT_VALUE):
                row = int((~(column.abs() <= MAX_SPLAT_VALUE)).nonzero()[0, 0])
                what = f"{name} of splat {row} of {len(self)} has NaN, Inf or a value beyond {MAX_SPLAT_VALUE:g}"
                raise BadInput(f"{where}: {what}; remove such splats first")

    def shown(self) -> Tensor:
        """(N,) about how much is seen of each splat: opacity times the product of its two larger radii."""
        larger = self.log_scales.detach().double().topk(2, dim=1).values.sum(1)
        return larger.exp() * torch.sigmoid(self.opacity_logits.detach().double())

    def median_scale(self) -> float:
        """Median radius in the plane of surfels, or along the first two axes of ellipsoids; 1 without splats."""
        return math.exp(min(max(float(np.median(self.log_scales[:, :2].cpu())), -60.0), 60.0)) if len(self) else 1.0

    def on_cpu(self) -> SplatTable:
        """The same splats on the CPU and without gradients: positions as they are, all else in float32."""
        columns = {name: getattr(self, name).detach().to("cpu", torch.float32) for name in SPLAT_COLUMNS[1:]}
        return replace(self, means=self.means.detach().cpu(), **columns)

    def in_local_frame(self, frame: Frame) -> SplatTable:
        """The same splats, of the frame of the input, in the local frame; positions in float32."""
        means = torch.from_numpy(frame.to_local(self.means.detach().cpu().numpy()).astype(np.float32))
        return replace(self, means=means, log_scales=self.log_scales + math.log(frame.scale))

    def take(self, rows: Tensor | slice) -> SplatTable:
        """The splats of a mask, of indices or of a slice."""
        return replace(self, **{name: getattr(self, name)[rows] for name in SPLAT_COLUMNS})


def joined(tables: Sequence[SplatTable]) -> SplatTable:
    """The splats of some tables of the same kind and degree, one table after the other."""
    columns: dict[str, Any] = {n: torch.cat([getattr(table, n) for table in tables]) for n in SPLAT_COLUMNS}
    return replace(tables[0], **columns)


@dataclass(frozen=True)
class Tile:
    """A box of a scene, drawn by some splats from far away and by its children from near.

    Attributes:
        splats: What is drawn in place of all that lies below.
        low, high: (3,) float64 corners of a box with the centres of all splats here and below, same frame.
        error: How far, in the units of `splats`, what is drawn lies from the full model: 0 for leaves.
        children: Smaller boxes that together replace this tile; none for a leaf, which has the model itself.
    """

    splats: SplatTable
    low: np.ndarray
    high: np.ndarray
    error: float = 0.0
    children: tuple[Tile, ...] = ()
