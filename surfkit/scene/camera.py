"""A pinhole camera with a pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """An undistorted pinhole camera: OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

    Attributes:
        world_to_camera: (4, 4) float64; the world is the scene's local frame.
        fx: Focal length along x, pixels.
        fy: Focal length along y, pixels.
        cx: Principal point, pixels from the left edge of the left-most pixel.
        cy: Principal point, pixels from the upper edge of the upper-most pixel.
        width: Pixels.
        height: Pixels.
    """

    world_to_camera: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def centre(self) -> Tensor:
        """(3,) float64 position in the world."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def fitted(self, longest: int) -> Camera:
        """The same camera with a longest side of at most `longest` pixels."""
        by = max(1.0, max(self.width, self.height) / longest)
        return self.resized(max(1, round(self.width / by)), max(1, round(self.height / by)))

    def project(self, points: Tensor) -> Tensor:
        """(P, 3) float64 x and y in pixels and z along the axis, of (P, 3) points of the world; z may be negative."""
        pose = self.world_to_camera.to(points.device)
        local = points.double() @ pose[:3, :3].T + pose[:3, 3]
        z = local[:, 2]
        return torch.stack([self.fx * local[:, 0] / z + self.cx, self.fy * local[:, 1] / z + self.cy, z], 1)

    def sized(self, longest: int) -> Camera:
        """The same camera with a longest side of `longest` pixels."""
        by = max(self.width, self.height) / longest
        return self.resized(max(1, round(self.width / by)), max(1, round(self.height / by)))

    def ray_axes(self, dtype: torch.dtype, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
        """(W,) and (H,), x of the rays through each column of pixels and y of those through each row, with z = 1."""
        x = (torch.arange(self.width, dtype=dtype, device=device) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=dtype, device=device) + 0.5 - self.cy) / self.fy
        return x, y

    def rays(self, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """(3, H, W) direction of every pixel centre in the camera frame, with z = 1."""
        x, y = self.ray_axes(dtype, device)
        grid_y, grid_x = torch.meshgrid(y, x, indexing="ij")
        return torch.stack([grid_x, grid_y, torch.ones_like(grid_x)])
