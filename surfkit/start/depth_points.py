"""The points of a depth map, with colours and normals."""

from __future__ import annotations

import torch
from torch import Tensor

from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.scene.camera import Camera
from surfkit.scene.vectors import unit
from surfkit.start.voxels import Samples

MAX_DEPTH_BEND = 0.02
"""Three inverse depths in a row that are bent by a larger share of the middle one do not lie on one surface."""


def focal(camera: Camera) -> float:
    """Focal length in pixels, of pixels that need not be square."""
    return (camera.fx * camera.fy) ** 0.5


def points_of(camera: Camera, prior: DepthPrior, photo: Tensor, there: Tensor) -> Samples:
    """The points of some pixels of a depth map, in the world; their weight is the confidence, their grain a pixel.

    Args:
        camera: Of the map.
        prior: The map.
        photo: (3, H, W) uint8.
        there: (H, W) bool, the pixels; each has a depth.
    """
    depth = 1 / prior.inverse[there].double()
    rays = camera.rays(torch.float64)[:, there]
    slopes = normals_of(camera, prior.inverse)
    given = slopes if prior.normal is None else torch.where(prior.normal.abs().sum(0) > 0, prior.normal, slopes)
    normal = given[:, there].double()
    normal = torch.where(normal.abs().sum(0) > 0, normal, -unit(rays))
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3:]
    return Samples(
        xyz=(turn.T @ (rays * depth - shift)).T.numpy(),
        rgb=photo[:, there].float().T.numpy(),
        normals=(turn.T @ normal).float().T.numpy(),
        weight=prior.confidence[there].numpy(),
        grain=(depth / focal(camera)).numpy(),
    )


def normals_of(camera: Camera, inverse: Tensor) -> Tensor:
    """(3, H, W) unit normals of a depth map, towards the camera; 0 at edges and where a neighbour has no depth.

    On a plane n . x = h the inverse depth c is linear in the image: with the ray r of a pixel, c = n . r / h. So its
    differences give n up to length: (fx dc/dx, fy dc/dy, c - (u - cx) dc/dx - (v - cy) dc/dy).

    Args:
        camera: Of the map.
        inverse: (H, W) inverse camera z; 0 where there is none.
    """
    c = inverse.double()
    across, along = _slope(c, 1), _slope(c, 0)
    rays = camera.rays(torch.float64)
    nx, ny = camera.fx * across, camera.fy * along
    normal = torch.stack([nx, ny, c - rays[0] * nx - rays[1] * ny])
    known = (across.isfinite() & along.isfinite() & (c > 0))[None]
    return torch.where(known, -unit(normal.nan_to_num()), 0).to(inverse.dtype)


def _slope(values: Tensor, dim: int) -> Tensor:
    """(H, W) change from a pixel to the next along an axis, NaN where it is not known or not that of one surface."""
    before, after = values.roll(1, dim), values.roll(-1, dim)
    smooth = ((before + after) / 2 - values).abs() < MAX_DEPTH_BEND * values
    slope = torch.where(smooth & (before > 0) & (after > 0), (after - before) / 2, torch.nan)
    slope.index_fill_(dim, torch.tensor([0, values.shape[dim] - 1]), torch.nan)
    return slope
