"""Which photographs show what another one shows, from another side: told by their cameras and a rendered depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.scene.camera import Camera

BEST_ANGLE_DEGREES = 10.0
"""Best angle between the rays of two views, degrees: less gives no parallax, more shows other things."""
FALLOFF_BELOW, FALLOFF_ABOVE = 1 / 3, 1.0
"""How fast a view loses worth below and above the best angle, as shares of it."""
PLACES_PER_SIDE = 8
"""A rendered depth is looked at in so many places along each side."""
MIN_DEPTH_PLACES = 8
"""With fewer places that have a depth, nothing is known of the view."""
NEIGHBOURS_PER_VIEW = 4
"""So many neighbours of each view take turns."""
MIN_WORTH, MIN_WORTH_RATIO = 0.1, 0.5
"""A neighbour is worth at least this, and at least this share of the best one."""


@dataclass(frozen=True)
class NeighbourSelector:
    """V cameras together.

    Attributes:
        cameras: V cameras.
        rotations: (V, 3, 3) float32, world to camera.
        shifts: (V, 3, 1) float32.
        centres: (V, 3, 1) float32 positions in the world.
        lenses: (V, 6, 1) float32 fx, fy, cx, cy, width, height.
    """

    cameras: Sequence[Camera]
    rotations: Tensor
    shifts: Tensor
    centres: Tensor
    lenses: Tensor

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> NeighbourSelector:
        """The cameras in one place."""
        poses = torch.stack([camera.world_to_camera for camera in cameras])
        rotations, shifts = poses[:, :3, :3], poses[:, :3, 3:]
        lenses = torch.tensor([[c.fx, c.fy, c.cx, c.cy, c.width, c.height] for c in cameras])
        centres = -rotations.transpose(1, 2) @ shifts
        return cls(cameras, rotations.float(), shifts.float(), centres.float(), lenses[..., None])

    def neighbours(self, at: int, depth: Tensor) -> list[int]:
        """Positions of up to `NEIGHBOURS_PER_VIEW` cameras that are worth comparing with, best first.

        A camera is worth the mean over places of the rendered surface of a number in [0, 1]: 0 where the place lies
        outside its picture; else exp(-(a - ANGLE)^2 / 2 s^2) with a the angle between the two rays, and s small below
        the best angle and large above; times the ratio of the sizes of a pixel there, the smaller by the larger.

        Args:
            at: Position of the camera.
            depth: (H, W) camera z that it shows, 0 where there is none; H and W may be a fraction of the camera's.
        """
        places = self.places(at, depth)
        if places.shape[1] < MIN_DEPTH_PLACES:
            return []
        worth = self.worth(at, places)
        worth[at] = 0
        order = worth.argsort(descending=True, stable=True)[:NEIGHBOURS_PER_VIEW].tolist()
        least = max(MIN_WORTH, MIN_WORTH_RATIO * float(worth[order[0]]))
        return [other for other in order if float(worth[other]) >= least]

    def places(self, at: int, depth: Tensor) -> Tensor:
        """(3, P) places in the world on the surface that a camera sees."""
        height, width = depth.shape
        y, x = (((torch.arange(PLACES_PER_SIDE) + 0.5) * size / PLACES_PER_SIDE).long() for size in (height, width))
        z = depth.detach()[y[:, None], x].flatten().float().cpu()
        rays = self.cameras[at].resized(width, height).rays()[:, y[:, None], x].flatten(1)
        seen = (rays * z)[:, z > 0]
        return self.rotations[at].T @ (seen - self.shifts[at])

    def worth(self, at: int, places: Tensor) -> Tensor:
        """(V,) in [0, 1], how well each camera shows the places from another side than one does."""
        rows = torch.cat([torch.tensor([at]), self.turned_to(places)])
        local = self.rotations[rows] @ places + self.shifts[rows]  # (R, 3, P)
        z = local[:, 2]
        ahead = z > 0
        fx, fy, cx, cy, width, height = (self.lenses[rows, k] for k in range(6))
        depth = torch.where(ahead, z, 1.0)
        x, y = fx * local[:, 0] / depth + cx, fy * local[:, 1] / depth + cy
        inside = ahead & (x > 0) & (x < width) & (y > 0) & (y < height)
        rays = torch.nn.functional.normalize(places - self.centres[rows], dim=1)
        cosine = (rays * rays[0]).sum(1).clamp(-1, 1)
        angle = cosine.acos() * (180 / math.pi)
        spread = BEST_ANGLE_DEGREES * torch.where(angle < BEST_ANGLE_DEGREES, FALLOFF_BELOW, FALLOFF_ABOVE)
        size = depth / fx
        ratio = size / size[0]
        worth = (-((angle - BEST_ANGLE_DEGREES) ** 2) / (2 * spread**2)).exp() * torch.minimum(ratio, 1 / ratio)
        found = torch.zeros(len(self.cameras))
        found[rows] = torch.where(inside, worth, 0.0).mean(1)
        return found

    def turned_to(self, places: Tensor) -> Tensor:
        """(C,) positions of the cameras with some of a ball around (3, P) places in their pictures: of many, only these
        few need be looked at place by place."""
        middle = places.mean(1, keepdim=True)
        radius = float((places - middle).norm(dim=0).max())
        ball = (self.rotations @ middle + self.shifts)[..., 0]  # (V, 3)
        fx, fy, cx, cy, width, height = (self.lenses[:, k, 0] for k in range(6))
        none = torch.zeros_like(fx)
        planes = (
            (none, none, none + 1),
            (fx, none, cx),
            (-fx, none, width - cx),
            (none, fy, cy),
            (none, -fy, height - cy),
        )
        normals = torch.stack([torch.stack(plane, 1) for plane in planes])  # (5, V, 3), into what is seen
        slack = radius + 1e-4 * (ball.norm(dim=1) + radius)  # of what float32 rounds
        return ((normals * ball).sum(2) + normals.norm(dim=2) * slack >= 0).all(0).nonzero()[:, 0]
