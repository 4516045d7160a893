"""A rectified pair of views: what stereo is given, and what it says of the left one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from surfkit.plugin import BadInput, Camera, DepthEstimator, DepthInput, Observations, Observations2D, View

SIDES = ("left", "right")
"""Names of the two views of a pair."""
GRID = 24
"""Points along each side of the picture that tell the estimator which depths to look at."""
FEWEST = 32
"""With fewer of these points in both pictures, the views of a pair have nothing in common."""


def shifted(camera: Camera, baseline: float) -> Camera:
    """The camera moved to its right: the rows of the two pictures are then the epipolar lines.

    Args:
        camera: The left one.
        baseline: Distance between the two, local units.
    """
    pose = camera.world_to_camera.clone()
    pose[0, 3] -= baseline
    return replace(camera, world_to_camera=pose)


@dataclass(frozen=True)
class Pair:
    """Two views side by side.

    Attributes:
        left: Camera of the view whose depth is sought.
        baseline: Distance between the two, local units.
        nearest: Least depth that is looked for, in baselines.
        farthest: Greatest depth, in baselines.
    """

    left: Camera
    baseline: float
    nearest: float
    farthest: float

    @property
    def right(self) -> Camera:
        """The camera of the partner."""
        return shifted(self.left, self.baseline)

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """Both, as in `SIDES`."""
        return self.left, self.right

    def depth_input(self, pictures: Sequence[Tensor], folder: Path) -> DepthInput:
        """What an estimator works from: the two pictures as files, and points that span the depths to look at.

        The points stand in for the sparse points of a data set. They lie on the rays of a grid of pixels, at inverse
        depths spread evenly over the range.

        Args:
            pictures: Two of (3, H, W) float32 colours.
            folder: For the files.
        """
        views = []
        for name, camera, picture in zip(SIDES, self.cameras, pictures, strict=True):
            path = folder / f"{name}.png"
            pixels = (picture.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0)
            Image.fromarray(pixels.cpu().numpy()).save(path, compress_level=1)
            views.append(View(name, camera, path))
        xyz = self.points()
        seen = {}
        for view in views:
            at = view.camera.project(xyz)[:, :2] / torch.tensor([view.camera.width, view.camera.height])
            inside = ((at > 0) & (at < 1)).all(1)
            rows = inside.nonzero()[:, 0]
            seen[view.name] = Observations2D(rows.numpy(), at[rows].numpy())
        known = Observations(xyz.numpy(), np.zeros(len(xyz)), seen)
        work = folder / "work"
        work.mkdir()
        return DepthInput(views, known, torch.device("cpu"), work, in_one_light=True)

    def points(self) -> Tensor:
        """(P, 3) float64 places on rays of the left camera that the right one sees too."""
        camera = self.left
        x, y = (((torch.arange(GRID).double() + 0.5) / GRID) * size for size in (camera.width, camera.height))
        y, x = (part.flatten() for part in torch.meshgrid(y, x, indexing="ij"))
        share = (torch.arange(len(x)).double() * 0.6180339887498949) % 1  # even along every row, and from row to row
        inverse = (1 - share) / self.farthest + share / self.nearest
        z = self.baseline / inverse
        local = torch.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z], 1)
        pose = camera.world_to_camera
        xyz = (local - pose[:3, 3]) @ pose[:3, :3]
        across = self.right.project(xyz)[:, 0]
        return xyz[(across > 0) & (across < camera.width)]

    def disparity(self, inverse: Tensor) -> Tensor:
        """(H, W) pixels f b / z of inverse depths, at the size of the view; 0 where there is none."""
        size = (self.left.height, self.left.width)
        whole = inverse if inverse.shape == size else interpolate(inverse[None, None], size, mode="nearest-exact")[0, 0]
        return whole * (self.left.fx * self.baseline)

    def depth(self, disparity: Tensor) -> Tensor:
        """(H, W) camera z = f b / d; 0 where there is none, or it lies outside of the range."""
        there = disparity > 0
        depth = torch.where(there, self.left.fx * self.baseline / torch.where(there, disparity, 1.0), 0.0)
        inside = (depth >= self.nearest * self.baseline) & (depth <= self.farthest * self.baseline)
        return torch.where(inside, depth, 0.0)


def consistent(left: Tensor, right: Tensor, tolerance_px: float) -> Tensor:
    """(H, W) bool, the left-right check: the disparity where a pixel falls in the other picture is nearly its own.

    Args:
        left: (H, W) disparity of the left picture, pixels; 0 where there is none.
        right: (H, W) of the right one.
        tolerance_px: Largest difference.
    """
    height, width = left.shape
    x = torch.arange(width, dtype=left.dtype) + 0.5 - left
    y = (torch.arange(height, dtype=left.dtype) + 0.5)[:, None].expand_as(x)
    grid = torch.stack([2 * x / width - 1, 2 * y / height - 1], -1)
    found = grid_sample(right[None, None], grid[None], mode="nearest", align_corners=False)[0, 0]
    return (left > 0) & (found > 0) & ((left - found).abs() <= tolerance_px)


@dataclass(frozen=True)
class Estimated:
    """The left view of a pair by stereo.

    Attributes:
        depth: (H, W) float32 camera z; 0 where there is none that both directions agree on.
        normal: (3, H, W) float32, camera frame, towards it; None from estimators without normals.
    """

    depth: Tensor
    normal: Tensor | None


def estimate(
    pair: Pair, pictures: Sequence[Tensor], estimator: DepthEstimator, tolerance_px: float, folder: Path
) -> Estimated:
    """Depth of the left view: matched both ways, and checked.

    Args:
        pair: The two views.
        pictures: Two of (3, H, W) float32 colours, as they are seen from the left and from the right.
        estimator: The stereo; it sees two photographs.
        tolerance_px: Of the left-right check.
        folder: Empty, for temporary files.

    Raises:
        BadInput: The two pictures show nothing together at the depths that are looked for.
    """
    given = pair.depth_input(pictures, folder)
    if len(given.observations.xyz) < FEWEST:
        raise BadInput(
            f"mesh.nearest is {pair.nearest:g}: at depths of {pair.nearest:g} to {pair.farthest:g} baselines the two "
            "pictures of a pair show different things; give a larger nearest"
        )
    found = {one.at: one for one in estimator.estimate(given, range(len(SIDES)))}
    size = (pair.left.height, pair.left.width)
    nothing = Estimated(torch.zeros(size), None)
    trusted = []
    for at in range(len(SIDES)):
        inverse, confidence = found[at].inverse, found[at].confidence
        if inverse is None or confidence is None:
            return nothing
        trusted.append(torch.where(confidence > 0, inverse, 0.0).cpu())
    left, right = (pair.disparity(inverse) for inverse in trusted)
    depth = pair.depth(torch.where(consistent(left, right, tolerance_px), left, 0.0))
    normal = found[0].normal
    if normal is not None and normal.shape[1:] != size:
        normal = interpolate(normal[None], size, mode="nearest-exact")[0]
    return Estimated(depth, None if normal is None else normal.cpu())
