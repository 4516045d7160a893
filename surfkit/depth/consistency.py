"""Whether the depth maps of several photographs describe one surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from surfkit.depth.cost_volume import ray_map, way_numbers
from surfkit.raster.native import kernels, module
from surfkit.scene.camera import Camera


def at_edge(inverse: Tensor, radius: int, share: float) -> Tensor:
    """(H, W) whether the surface ends within `radius` pixels, and what is behind lies further by `share` of the depth.

    There, windows that are compared also show what is behind, and the nearer surface comes out too large. Inverse depth
    is linear in the image on a plane, however steep, so the mean of two opposite neighbours tells slopes from edges.
    """
    height, width = inverse.shape
    around = pad(inverse[None], (radius, radius, radius, radius), mode="replicate")[0]

    def moved(y: int, x: int) -> Tensor:
        return around[radius + y : radius + y + height, radius + x : radius + x + width]

    steps = [(k * y, k * x) for y, x in ((0, 1), (1, 0), (1, 1), (1, -1)) for k in range(1, radius + 1)]
    bend = torch.stack([inverse - (moved(y, x) + moved(-y, -x)) / 2 for y, x in steps]).amax(0)
    return bend > inverse * share / 2


class DepthConsistency(NamedTuple):
    """What other maps say of the pixels of a map.

    Attributes:
        agreeing: (H, W) number of maps that agree.
        shown: (H, W) number of maps that have a depth in the same place, whether it agrees or not.
        fused: (H, W) inverse depth, the mean of what the maps that agree and the map itself say.
    """

    agreeing: Tensor
    shown: Tensor
    fused: Tensor

    def trust(self, enough: int) -> Tensor:
        """(H, W) in [0, 1]: 1 where `enough` maps agree, or all that show the place if fewer do, but 2 at least."""
        return (self.agreeing / self.shown.clamp(2, max(2, enough))).clamp_max(1)


def agreement(
    camera: Camera, inverse: Tensor, others: Sequence[tuple[Camera, Tensor]], tolerance: float
) -> DepthConsistency:
    """How many other maps agree with each pixel.

    A pixel is carried into another photograph; the maps agree where the depth there differs by a share of less than
    `tolerance` from that in the other map.

    Args:
        camera: Of the map.
        inverse: (H, W) inverse depth; 0 where there is none.
        others: Cameras and maps of other photographs.
        tolerance: Share of the depth.
    """
    if module() is None or inverse.device.type != "cpu":
        return agreement_in_torch(camera, inverse, others, tolerance)
    made = [np.empty(inverse.shape, np.float32) for _ in range(3)]
    kernels().depth_agreement(
        np.ascontiguousarray(inverse.numpy(), np.float32),
        [camera.fx, camera.fy, camera.cx, camera.cy],
        [np.ascontiguousarray(other.numpy(), np.float32) for _, other in others],
        [way_numbers(camera, there) for there, _ in others],
        tolerance,
        *made,
        torch.get_num_threads(),
    )
    return DepthConsistency(*map(torch.from_numpy, made))


def agreement_in_torch(
    camera: Camera, inverse: Tensor, others: Sequence[tuple[Camera, Tensor]], tolerance: float
) -> DepthConsistency:
    """The same in torch: on a GPU, where surfkit has no compiled part, and to check that."""
    count, shown, ratios = torch.zeros_like(inverse), torch.zeros_like(inverse), torch.ones_like(inverse)
    for there, other in others:
        a, b = ray_map(camera, there, inverse.device)
        x, y, z = (a[i] + inverse * b[i] for i in range(3))
        grid = torch.stack([x / z * (2 / there.width) - 1, y / z * (2 / there.height) - 1], -1)
        found = grid_sample(other[None, None], grid[None], mode="nearest", align_corners=False)[0, 0]
        ratio = found * z / inverse.clamp_min(1e-20)  # depth carried over / depth found
        known = (inverse > 0) & (z > 0) & (found > 0)
        agrees = known & ((ratio - 1).abs() < tolerance)
        shown += known
        count += agrees
        ratios += torch.where(agrees, ratio, 0)
    return DepthConsistency(count, shown, inverse * ratios / (count + 1))
