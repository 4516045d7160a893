"""Depth from several photographs, without learnt weights."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput, require_within
from surfkit.core.memory import size
from surfkit.depth.base import DepthEstimator, DepthInput, Estimate
from surfkit.depth.consistency import agreement, at_edge
from surfkit.depth.cost_volume import PosedImage, cost_volume, ray_map
from surfkit.depth.neighbours import MAX_CANDIDATE_VIEWS, depth_range, neighbours
from surfkit.depth.semi_global_matching import best_planes, smooth_costs
from surfkit.io.datasets.depth_files import save_array
from surfkit.scene.available_memory import free_bytes
from surfkit.scene.camera import Camera
from surfkit.scene.photos import read_photo
from surfkit.scene.scene import View

MAX_CACHED_PICTURES = 64
"""Pictures kept in memory."""
VOLUME_BYTES = 16
"""For each pixel and depth: the costs, their smoothed sums, and both again turned."""
PLANE_SWEEP_RANGES = {
    "longest": (1, 20_000),
    "neighbours": (1, MAX_CANDIDATE_VIEWS),
    "angle": (0.01, 180),
    "step_px": (0.01, 100),
    "max_planes": (3, 10_000),
    "margin": (0, 100),
    "window": (3, 51),
    "step_cost": (1e-6, 1000),
    "jump_cost": (1e-6, 1000),
    "tolerance": (1e-6, 1),
    "agree": (1, MAX_CANDIDATE_VIEWS),
}
"""Of the settings: what is larger only costs time, which grows with the side of a window and the number of depths."""


@dataclass(frozen=True)
class PlaneSweep(DepthEstimator):
    """Plane-sweep stereo (Collins 1996) with semi-global matching and a consistency check between the depth maps."""

    aligned: ClassVar[bool] = True
    matched: ClassVar[bool] = True

    longest: int = 480
    """Longest side of a depth map in pixels; time grows with its third power."""

    neighbours: int = 5
    """Source photographs for each photograph."""

    angle: float = 8.0
    """Preferred angle between the rays of two photographs, degrees: a smaller one gives less parallax, at a larger one
    they look different."""

    visible: float = 0.5
    """Share of the source photographs that a point is scored by; in the others it may be occluded."""

    step_px: float = 1.0
    """Distance between two depth planes: by how many pixels a source image moves."""

    max_planes: int = 192
    """Maximum number of depth planes; it bounds time and memory."""

    margin: float = 0.15
    """Margin added to the range of inverse depths of the sparse points, as a share of that range."""

    window: int = 5
    """Side of the matching window, pixels; odd."""

    step_cost: float = 0.1
    """Cost of a change by one depth plane from a pixel to the next; 1 is the cost of a wrong match."""

    jump_cost: float = 1.0
    """Cost of a larger change of depth from a pixel to the next."""

    tolerance: float = 0.015
    """Relative difference of depth up to which the maps of two photographs agree."""

    edge: float = 0.02
    """Relative jump in depth that makes an edge; the nearer side of an edge gets no confidence, as matching widens
    it."""

    agree: int = 2
    """Source photographs whose depth maps must agree for full confidence."""

    def __post_init__(self) -> None:
        require_within(PLANE_SWEEP_RANGES, self)
        if self.window % 2 == 0:
            raise BadInput(f"window is {self.window}; it must be an odd number of pixels, so that it has a middle")
        if not 0 < self.visible <= 1:
            raise BadInput(f"visible is {self.visible:g}; it is a share of the neighbours, above 0 and at most 1")
        if not (0 < self.edge < 1 and self.step_cost <= self.jump_cost):
            raise BadInput("edge must be in (0, 1), and step_cost no more than jump_cost")

    def of_map(self, camera: Camera) -> Camera:
        """See `DepthEstimator.of_map`."""
        return camera.fitted(self.longest)

    def refuse_unfit(self, views: Sequence[View]) -> None:
        """See `DepthEstimator.refuse_unfit`."""
        refuse_wide_window(self.window, {view.name: self.of_map(view.camera) for view in views})

    def estimate(self, given: DepthInput, wanted: Sequence[int]) -> Iterator[Estimate]:
        pairs = neighbours(given.views, given.observations, self.neighbours, self.angle)

        @lru_cache(MAX_CACHED_PICTURES)
        def picture(at: int) -> PosedImage:
            return self.picture(given, at)

        @lru_cache(MAX_CACHED_PICTURES)
        def sweep(at: int) -> tuple[Tensor, Tensor] | None:
            path = given.work / f"{at:06d}.npy"
            if not path.exists():
                found = self.sweep(given, at, picture(at), [picture(other) for other in pairs[at]])
                save_array(path, np.zeros(0) if found is None else torch.stack(found).cpu().numpy())
            both = torch.from_numpy(np.load(path)).to(given.device)
            return (both[0], both[1]) if len(both) else None

        for at in wanted:
            maps = {near: found for near in [at, *pairs[at]] if (found := sweep(near)) is not None}
            if at not in maps:
                yield Estimate(at, None, None)
                continue
            inverse, matched = maps.pop(at)
            others = [(picture(near).camera, found) for near, (found, _) in maps.items()]
            said = agreement(picture(at).camera, inverse, others, self.tolerance)
            trusted = said.trust(self.agree)
            trusted[at_edge(inverse, self.window // 2, self.edge)] = 0
            yield Estimate(at, said.fused.cpu(), (trusted * matched).cpu())

    def picture(self, given: DepthInput, at: int) -> PosedImage:
        """A photograph at the working size."""
        view = given.views[at]
        camera = self.of_map(view.camera)
        rgb = read_photo(view.path, (camera.width, camera.height), pixels=view.pixels)
        return PosedImage(camera, rgb.to(given.device, torch.float32) / 255)

    def sweep(
        self, given: DepthInput, at: int, here: PosedImage, others: Sequence[PosedImage]
    ) -> tuple[Tensor, Tensor] | None:
        """(H, W) inverse depth and how well it matches, in [0, 1]; None without neighbours or sparse points."""
        span = depth_range(given.views[at], given.observations, self.margin)
        if span is None or not others:
            return None
        count = self.planes(here, others, span)
        self.refuse_too_large(here, count, given.device)
        planes = torch.linspace(*span, count, device=given.device)
        volume = cost_volume(here, others, planes, self.window, self.visible)
        plane, position = best_planes(smooth_costs(volume, here.light, self.step_cost, self.jump_cost))
        inverse = span[0] + position * ((span[1] - span[0]) / (count - 1))
        matched = 1 - volume.gather(0, plane[None])[0]
        inner = (plane > 0) & (plane < count - 1)
        return inverse, torch.where(inner, matched, 0)

    def refuse_too_large(self, here: PosedImage, count: int, device: torch.device) -> None:
        """BadInput if the costs of `count` depths would not fit into memory."""
        needed = VOLUME_BYTES * count * here.camera.width * here.camera.height
        free = free_bytes() if device.type == "cpu" else torch.cuda.mem_get_info(device)[0]
        if needed > free:
            longest = int(max(here.camera.width, here.camera.height) * (free / needed) ** (1 / 3))
            raise BadInput(
                f"depth maps of {here.camera.width} x {here.camera.height} pixels with {count} depths to try take "
                f"{size(needed)}, and {size(free)} are free; {self.remedy(max(1, longest))}"
            )

    def remedy(self, longest: int) -> str:
        """What to do for maps whose longest side is no more than so many pixels."""
        return f"give --estimator.longest {longest} or less, or a lower --estimator.max-planes"

    def planes(self, here: PosedImage, others: Sequence[PosedImage], span: tuple[float, float]) -> int:
        """How many depths to try, so that no picture moves by more than a step from one to the next."""
        moves = []
        for other in others:
            a, b = ray_map(here.camera, other.camera, torch.device("cpu"))
            ends = [a[:, ::16, ::16] + c * b[:, None, None] for c in span]
            x, y = (ends[1][i] / ends[1][2] - ends[0][i] / ends[0][2] for i in range(2))
            moves.append(float(torch.hypot(x, y).median()))
        most = max(move if math.isfinite(move) else math.inf for move in moves)  # a pixel may pass through a camera
        return min(max(3, round(min(most, 1e9) / self.step_px) + 1), self.max_planes)


def refuse_wide_window(window: int, cameras: Mapping[str, Camera]) -> None:
    """BadInput if a window is larger than all depth maps, of which the cameras are given by name.

    Where only some are smaller, such as a thumbnail among photographs, little is found in these.
    """
    sides = {name: min(camera.width, camera.height) for name, camera in cameras.items()}
    name = max(sides, key=lambda each: sides[each], default="")
    if 3 <= sides.get(name, 0) < window:  # in smaller ones nothing is found, with any window
        raise BadInput(
            f"window is {window}, and the largest depth map, of {name}, is {cameras[name].width} x "
            f"{cameras[name].height} pixels: give an odd number from 3 to {sides[name]}"
        )
