"""Trust by agreement: depth that other views find in the same place, as in the fusion of stereo depth maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.depth.cost_volume import ray_map, way_numbers
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh.overlap import Depths, overlapping
from surfkit.mesh.trust import Trust
from surfkit.raster.api import Maps
from surfkit.raster.native import kernels, module
from surfkit.scene.camera import Camera

MIN_CONTRADICTING_CONFIDENCE = 0.375
"""Confidence of a prior from which it may contradict."""
CONTRADICTION_TOLERANCES = 3.0
"""Tolerances between a depth and a confident prior from which they contradict each other."""


@dataclass(frozen=True)
class GeometricConsistency(Trust):
    """Weigh pixels by how many other views see a surface in the same place, and leave out those that no view confirms.

    After Merrell et al. (2007): a depth is carried into other views, and what these see there is carried back.
    """

    neighbours: int = 8
    """Other views that each view is compared with: those that share most of its surface at another angle."""

    angle: float = 12.0
    """Preferred angle between the rays of two views that are compared, degrees."""

    tolerance: float = 0.01
    """Relative difference up to which two depths agree."""

    enough: float = 2.0
    """Number of agreeing views for the full weight; fewer give a share of it."""

    alone: float = 0.25
    """Weight of pixels that no other view can confirm or contradict, as a share of the full one."""

    covered_by: int = 0
    """Number of the compared views that must have a place in their picture, with some depth there: places that fewer
    look at, as at the rim of a survey, are left out. No more than half of those that look at most of a view, so that
    photographs with little overlap keep their surface. Not for depth with holes, as of stereo alone."""

    opaque: float = 0.5
    """Minimum alpha of a pixel that counts."""

    spread: float = 0.0
    """Relative difference between median and expected depth at which the weight is halved, as splats are spread along
    the ray there; 0 turns this off."""

    priors: Literal["ignore", "weigh"] = "ignore"
    """Whether depth priors count, where the data set has them: weigh raises the weight of pixels that agree with them
    by the factor `confirmed`, and leaves out those that they contradict."""

    confirmed: float = 2.0
    """See `priors`; at a confidence below 1 the factor is closer to 1."""

    def __post_init__(self) -> None:
        for name, low, high in (("tolerance", 0, 1), ("angle", 0, 45)):
            if not low < getattr(self, name) < high:
                raise BadInput(f"mesh.trust.{name} is {getattr(self, name):g}; it must be between {low} and {high}")
        for name, low, high in (("alone", 0, 1), ("opaque", 0, 1), ("spread", 0, 1), ("confirmed", 1, 4)):
            if not low <= getattr(self, name) <= high:
                raise BadInput(f"mesh.trust.{name} is {getattr(self, name):g}; it must be from {low} to {high}")
        if self.neighbours < 1 or not 0 < self.enough < float("inf"):
            raise BadInput(
                f"mesh.trust.neighbours is {self.neighbours} and enough {self.enough:g}; give 1 or more and more than 0"
            )
        if self.covered_by < 0:
            raise BadInput(f"mesh.trust.covered_by is {self.covered_by}; it must be 0 or more")

    @property
    def needs_prior(self) -> bool:
        """See `Trust.needs_prior`."""
        return self.priors == "weigh"

    def within(self, maps: Maps, depth: Tensor, prior: DepthPrior | None) -> Tensor:
        """See `Trust.within`."""
        trust = torch.ones_like(depth)
        if maps.alpha is not None:
            trust = (maps.alpha >= self.opaque).to(depth.dtype)
        if self.spread and maps.median is not None and maps.depth is not None:
            apart = (maps.expected_depth() - maps.median).abs() / depth.clamp_min(1e-20)
            trust = trust / (1 + (apart / self.spread) ** 2)
        if self.needs_prior and prior is not None:
            off = (depth * prior.inverse - 1).abs()
            known = (prior.inverse > 0) & (prior.confidence > 0)
            raised = 1 + (self.confirmed - 1) * prior.confidence
            trust = torch.where(known & (off < self.tolerance), trust * raised, trust)
            wrong = (
                known
                & (prior.confidence >= MIN_CONTRADICTING_CONFIDENCE)
                & (off > CONTRADICTION_TOLERANCES * self.tolerance)
            )
            trust = torch.where(wrong, 0.0, trust)
        return trust

    def among(self, at: int, depths: Depths) -> Tensor:
        """See `Trust.among`."""
        camera, depth = depths.cameras[at], depths.read(at)
        agreeing, against = torch.zeros_like(depth), torch.zeros_like(depth)
        looking = torch.zeros_like(depth)
        for other in overlapping(at, depths, self.neighbours, self.angle):
            close, apart, looks = compare(camera, depth, depths.cameras[other], depths.read(other), self.tolerance)
            agreeing += close
            against += apart
            looking += looks
        share = agreeing / (agreeing + against).clamp_min(1e-6)
        confirmed = (agreeing / self.enough).clamp_max(1) * share
        unknown = (agreeing == 0) & (against == 0)
        counts = (depth > 0) & (looking >= self._least_looking(looking[depth > 0]))
        return torch.where(counts, torch.where(unknown, self.alone, confirmed), 0.0)

    def _least_looking(self, looking: Tensor) -> float:
        """How many views must look at a place of a view, from the (P,) numbers of those that do."""
        return min(self.covered_by, float((looking.median() / 2).ceil())) if len(looking) else 0


def compare(
    camera: Camera, depth: Tensor, there: Camera, other: Tensor, tolerance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """How well another view's depth agrees with each pixel, whether it contradicts, and whether it looks there.

    The point that a pixel shows is carried into the other view. If what is seen there is as far, they agree; if it is
    further, the other view sees through the point. If it is nearer, it hides the point, unless this view in turn sees
    through what is nearer. To see through a place, all pixels around it must: beside an edge, which of them it falls on
    is chance. Views that do not see the point, or that it is hidden from, are ignored.

    Args:
        camera: Of the pixels.
        depth: (H, W) their depth, camera z; 0 for none.
        there: Camera of the other view.
        other: (h, w) its depth.
        tolerance: Share of the depth.

    Returns:
        (H, W) agreement from 0 to 1, (H, W) 1 where the other view contradicts, else 0, and (H, W) 1 where it has some
        depth in the direction of the place, else 0.
    """
    if module() is None:
        return compare_in_torch(camera, depth, there, other, tolerance)
    turn = camera.world_to_camera @ torch.linalg.inv(there.world_to_camera)
    made = [np.empty(depth.shape, np.float32) for _ in range(3)]
    kernels().compare_depths(
        *(np.ascontiguousarray(some.numpy(), np.float32) for some in (depth, other)),
        [camera.fx, camera.fy, camera.cx, camera.cy],
        way_numbers(camera, there),
        turn[:3, 3].tolist(),
        tolerance,
        *made,
        torch.get_num_threads(),
    )
    agreement, against, looks = map(torch.from_numpy, made)
    return agreement, against, looks


def compare_in_torch(
    camera: Camera, depth: Tensor, there: Camera, other: Tensor, tolerance: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The same in torch, several times slower: where surfkit has no compiled part, and to check that."""
    a, b = ray_map(camera, there, depth.device)
    inverse = 1 / depth.clamp_min(1e-20)
    x, y, z = (a[i] + inverse * b[i] for i in range(3))
    found = _taken(other, x / z, y / z, (depth > 0) & (z > 0))
    ratio = found / (z * depth)  # of what is seen there to where the point lies there
    known = found > 0
    off = ((ratio - 1) / tolerance) ** 2
    agreement = torch.where(known, (1 - off).clamp_min(0), 0.0)
    nearest = _taken(_nearest(other), x / z, y / z, known)
    seen_through = known & (ratio > 1 + tolerance) & (nearest > (1 + tolerance) * z * depth)
    hidden = known & (ratio < 1 - tolerance)
    # What hides the point lies on the line from the other view's centre to it.
    turn = camera.world_to_camera @ torch.linalg.inv(there.world_to_camera)
    eye = turn[:3, 3].to(depth.dtype)
    rays = camera.rays(depth.dtype)
    p, q, r = (eye[i] + (rays[i] * depth - eye[i]) * ratio for i in range(3))
    beyond = _taken(_nearest(depth), p / r * camera.fx + camera.cx, q / r * camera.fy + camera.cy, hidden & (r > 0))
    looked_through = (beyond > 0) & (beyond > r * (1 + tolerance))
    return agreement, (seen_through | looked_through).to(depth.dtype), known.to(depth.dtype)


def _nearest(depth: Tensor) -> Tensor:
    """(H, W) the least depth of each pixel that has some and of those around it; 0 where it has none."""
    known = torch.where(depth > 0, depth, torch.inf)
    least = -torch.nn.functional.max_pool2d(-known[None, None], 3, 1, 1)[0, 0]
    return torch.where(depth > 0, least, 0.0)


def _taken(values: Tensor, x: Tensor, y: Tensor, where: Tensor) -> Tensor:
    """The values of the pixels that positions fall on; 0 outside of the picture, and where it is not wanted."""
    height, width = values.shape
    inside = where & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    rows, columns = (torch.where(inside, at, 0.0).long() for at in (y, x))
    return torch.where(inside, values[rows, columns], 0.0)
