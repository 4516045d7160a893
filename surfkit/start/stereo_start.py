"""Initial points from depth maps."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.primitives.init import gaps
from surfkit.scene.scene import Scene, SparsePoints
from surfkit.scene.vectors import unit
from surfkit.start.base import Start, StartInput
from surfkit.start.depth_points import focal, points_of
from surfkit.start.space_carving import closing_points
from surfkit.start.voxels import NOISE_NEIGHBOURS, Thinned, VoxelAccumulator, find_isolated, thin_to

FILL_GAP_VOXELS = 2.0
"""A sparse point is used where no point of the depth maps lies within so many voxels."""
SPARSE_OPACITY = 0.1
"""Of sparse points that fill gaps, as of a start from them alone."""
SPARSE_SIZE = 4.0
"""Their standard deviation, in distances between them. Most lie at the rim, where few or no photographs show more: what
begins small is still small there after a thousand steps, and leaves black between. (On examples/boruszyn 1, 2, 4 and 8
times: 21.3, 21.2, 21.8 and 21.4 dB, means of three seeds.)"""
MIN_POINT_SHARE = 0.9
"""A start with less than this share of the points that were asked for is told."""
PHOTOS_PER_PLACE = 10
"""How often a place is photographed, for a forecast; a rule of thumb for aerial surveys."""
CLOSING_POINTS_SHARE = 0.6
"""Points where no depth is trusted, for each point of the depth maps, for a forecast: 0.55 in a city of alleys."""

CPU_STEPS_PER_PHOTO, MIN_CPU_STEPS, MAX_CPU_STEPS = 30, 1_000, 30_000
"""Steps for each photograph, at least and at most, on a CPU. Measured with recipe:surface (docs/measured.md, "How many
steps"): PSNR on boruszyn is flat from 25 steps a photograph on, on ochota it is 22.6, 23.4 and 24.0 dB with 11, 24 and
55, and F1 on the synthetic Shibuya is flat from 13 on."""
GPU_STEPS_PER_PHOTO, MIN_GPU_STEPS = 120, 4_000
"""The same on a GPU, where a step takes a hundredth of the time."""


@dataclass(frozen=True)
class StereoStart(Start):
    """Start from the fused depth maps of all views, thinned evenly (as EDGS, Kotovenko et al. 2025, from matches).

    Colours come from the photographs, and directions from normal maps or the slopes of the depth maps. Sparse points
    are used only where the maps have none. With `closing`, points also lie where no depth is trusted: at such depth
    that nothing contradicts, and on the surfaces that close the space which trusted depth sees into. What is left is
    for densification.
    """

    points: int | Literal["auto"] = "auto"
    """Number of points; auto places one every `spacing_px` pixels at the median depth of the data set, `most` at
    most."""

    spacing_px: float = 3.0
    """Distance between points when their number is auto, in pixels of a training photograph at the median depth."""

    most: int = 2_000_000
    """Maximum number of points when it is auto."""

    min_confidence: float = 0.25
    """Pixels of lower confidence are not used. Wrong points are soon moved or pruned; missing ones are harder to
    replace."""

    opacity: float = 0.5
    """Initial opacity; depth maps are reliable, so it may be higher than that of sparse points, 0.1."""

    size: float = 0.65
    """Initial standard deviation of a splat, as a share of the distance between points; for sparse points it is four
    times the distance, as most of them lie at the rim, where few photographs teach anything."""

    closing: float = 0.0
    """Initial opacity of points where no depth is trusted, as in alleys. They lie at depth that is not trusted, if
    trusted depth of other views does not see through it, and where the space that trusted depth sees into may end: what
    it neither sees nor sees through is taken for what lies above it, free or solid. They are guesses, which training
    keeps or fades. 0: none."""

    def __post_init__(self) -> None:
        if self.points != "auto" and self.points < 1:
            raise BadInput(f"start.points is {self.points}; it must be auto, or 1 or more")
        if self.most < 1:
            raise BadInput(f"start.most is {self.most}; it must be 1 or more")
        for name, low, high in (("spacing_px", 0.01, 1000), ("size", 0.01, 100)):
            if not low <= getattr(self, name) <= high:
                raise BadInput(f"start.{name} is {getattr(self, name):g}; it must be from {low:g} to {high:g}")
        if not 0 <= self.closing < 1:
            raise BadInput(f"start.closing is {self.closing:g}; it must be at least 0 and below 1")
        if not (0 < self.opacity < 1 and 0 < self.min_confidence <= 1):
            raise BadInput("start.opacity must lie between 0 and 1, and start.min_confidence above 0 and at most at 1")

    @property
    def is_dense(self) -> bool:
        """See `Start.is_dense`."""
        return True

    def usual_steps(self, photographs: int, on_gpu: bool) -> int:
        """See `Start.usual_steps`."""
        each, least = (GPU_STEPS_PER_PHOTO, MIN_GPU_STEPS) if on_gpu else (CPU_STEPS_PER_PHOTO, MIN_CPU_STEPS)
        return min(max(each * photographs, least), MAX_CPU_STEPS)

    @property
    def needs_prior(self) -> bool:
        """See `Start.needs_prior`."""
        return True

    @property
    def most_points(self) -> int:
        """See `Start.most_points`."""
        return self.most if self.points == "auto" else self.points

    def limited(self, points: int) -> StereoStart:
        """See `Start.limited`."""
        wanted = self.points if self.points == "auto" else min(self.points, points)
        return replace(self, points=wanted, most=min(self.most, points))

    def cloud(self, known: StartInput) -> SparsePoints:
        """See `Start.cloud`."""
        stereo = self.fused(known)
        if not len(stereo):
            emit(Warned("no pixel of a depth map is trusted, so the run starts from the sparse points alone"))
            return known.scene.cloud
        if self.points != "auto" and len(stereo) < MIN_POINT_SHARE * self.points:
            emit(Warned(f"start.points is {self.points:,}, and the depth maps give {len(stereo):,}, a pixel apart"))
        return fill_gaps(stereo, self.closed(known, stereo), known, self)

    def closed(self, known: StartInput, stereo: Thinned) -> Thinned:
        """The points where no depth is trusted; together with those of the depth maps no more than are wanted."""
        if not self.closing:
            return Thinned.none()
        most = self.most if self.points == "auto" else self.points
        return closing_points(known, stereo, lambda at: self.unsure(known, at), max(0, most - len(stereo)))

    def expected(self, sparse: int, pixels: int) -> int:
        """See `Start.expected`."""
        if self.points != "auto":
            return self.points
        stereo = pixels / (PHOTOS_PER_PLACE * self.spacing_px**2) * (1 + CLOSING_POINTS_SHARE * (self.closing > 0))
        return max(sparse, min(self.most, round(stereo)))

    def fused(self, known: StartInput) -> Thinned:
        """The points of all depth maps, thinned."""
        wanted = self.most if self.points == "auto" else self.points
        unit = self.spacing_px if self.points == "auto" else 1.0
        priors, collected, scene = known.priors or (), None, known.scene
        for at, view in enumerate(scene.train):
            prior = priors[at] if len(priors) else None
            if prior is not None:
                if collected is None:
                    side = unit * pixel_size(scene, prior)
                    collected = VoxelAccumulator.for_points(side, wanted)
                with suppress(BadInput):  # a damaged photograph: training passes over it too, and tells
                    found = points_of(view.camera, prior, known.photos[at], self.trusted(known, at, prior))
                    collected.add(replace(found, grain=unit * found.grain))
            emit(Progress("points of depth maps", at + 1, len(scene.train)))
        if collected is None:
            return Thinned.none()
        voxels = collected.settle()
        rough = thin_to(voxels, wanted)
        if wanted <= NOISE_NEIGHBOURS:  # too few to tell which of them lie alone
            return rough
        noise = rough.take(find_isolated(rough))
        return thin_to(voxels.away_from(noise), wanted) if len(noise) else rough

    def trusted(self, known: StartInput, at: int, prior: DepthPrior) -> Tensor:
        """(H, W) which pixels of a depth map are used."""
        mask = None if known.masks is None else known.masks[at]
        trusted = (prior.inverse > 0) & (prior.confidence >= self.min_confidence)
        return trusted if mask is None else trusted & mask

    def unsure(self, known: StartInput, at: int) -> Tensor | None:
        """(H, W) which pixels of a photograph have no depth that is used, or None without a depth map."""
        prior = known.priors[at] if known.priors else None
        if prior is None:
            return None
        unused = ~self.trusted(known, at, prior)
        mask = None if known.masks is None else known.masks[at]
        return unused if mask is None else unused & mask


def pixel_size(scene: Scene, prior: DepthPrior) -> float:
    """Side of a pixel at the typical depth of a data set, local units, in the median over its views."""
    return 1 / (prior.typical * float(np.median([focal(view.camera) for view in scene.train])))


def fill_gaps(stereo: Thinned, closing: Thinned, known: StartInput, start: StereoStart) -> SparsePoints:
    """Points of depth maps, those that close what these see into, and sparse points where maps have none."""
    from scipy.spatial import cKDTree

    sparse = known.scene.cloud
    distance, near = cKDTree(stereo.xyz).query(sparse.xyz.numpy())
    more = torch.from_numpy(distance > FILL_GAP_VOXELS * stereo.size[near])
    anyhow = torch.randn(int(more.sum()), 3, generator=known.generator)
    made = [(points, torch.from_numpy(points.xyz).float()) for points in (stereo, closing) if len(points)]
    colors = [torch.from_numpy(points.rgb.round().clip(0, 255)).to(torch.uint8) for points, _ in made]
    counts = torch.tensor([len(stereo), len(closing), len(anyhow)])
    return SparsePoints(
        xyz=torch.cat([*(xyz for _, xyz in made), sparse.xyz[more]]),
        rgb=torch.cat([*colors, sparse.rgb[more]]),
        normals=torch.cat([*(torch.from_numpy(points.normals).float() for points, _ in made), unit(anyhow, 1)]),
        opacity=torch.tensor([start.opacity, start.closing, SPARSE_OPACITY]).repeat_interleave(counts),
        size=torch.cat([*(start.size * gaps(xyz) for _, xyz in made), SPARSE_SIZE * gaps(sparse.xyz[more])]),
    )
