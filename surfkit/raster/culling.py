"""What a camera may show, told before anything is projected; `Outlook` of project.h is the same for the CPU."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surfkit.raster.api import ALONG_RAYS, CUTOFF, Splats
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.scene.camera import Camera

SPLAT_MARGIN_PX = 3.0
"""Pixels beyond the image at which a splat may still touch it: the low-pass filter of a disc reaches 2.36."""
HELD_SLOPE_SHARE = 0.15
"""Share of the image beyond its sides at which the slope of the footprint of a Gaussian is held."""
BOUND_ROUNDING = 1e-3
"""Share by which bounds are widened, for what float32 rounds."""


def may_touch(splats: Splats, camera: Camera, near: float) -> Tensor:
    """(N,) bool: False for splats that surely touch no pixel, so that a rasterizer need not be given them.

    A few are True that touch none either, such as those that are hidden or too faint.

    Args:
        splats: Of a kind in `KINDS`.
        camera: World is the splats' frame.
        near: As in `Rasterizer.render`.
    """
    pose = camera.world_to_camera.to(splats.means)
    reach = splats.scales.amax(1) * (CUTOFF * (1 + BOUND_ROUNDING))
    if splats.kind == "gaussian" and splats.geometry not in ALONG_RAYS:
        return _blurred(splats, splats.means @ pose[:3, :3].T + pose[:3, 3], reach, camera, near)
    planes = torch.tensor([*image_sides(camera), [0.0, 0.0, 1.0]]).to(pose)  # the last: the depth
    beyond = torch.addmm(planes @ pose[:3, 3], splats.means, (planes @ pose[:3, :3]).T)
    return (beyond[:, :4] <= reach[:, None]).all(1) & (beyond[:, 4] > (1 - BOUND_ROUNDING) * near)


def image_sides(camera: Camera) -> list[list[float]]:
    """(4, 3): unit normals of the planes through the camera and the sides of the image, a margin away, pointing out;
    in the camera's frame."""
    left, top = -SPLAT_MARGIN_PX - camera.cx, -SPLAT_MARGIN_PX - camera.cy
    right, bottom = camera.width + SPLAT_MARGIN_PX - camera.cx, camera.height + SPLAT_MARGIN_PX - camera.cy
    away = [[-camera.fx, 0, left], [camera.fx, 0, -right], [0, -camera.fy, top], [0, camera.fy, -bottom]]
    return [[value / math.hypot(*plane) for value in plane] for plane in away]


def boxes_may_touch(boxes: SplatBoxes, camera: Camera, near: float) -> Tensor:
    """(B,) bool: False for boxes of which no splat may touch a pixel (`may_touch`).

    A splat passes `may_touch` if its mean is no farther beyond each of some planes than its reach times a factor. The
    means of a box are at most its support beyond a plane, and the reach of its splats is that of the largest.
    """
    pose = camera.world_to_camera.to(boxes.low)
    sides, share = _planes(boxes, camera)
    planes = torch.tensor([*sides, [0.0, 0.0, -1.0]]).to(pose)  # the last: how far before the camera
    normals, offsets = planes @ pose[:3, :3], planes @ pose[:3, 3]
    middle, half = (boxes.low + boxes.high) / 2, (boxes.high - boxes.low) / 2
    nearest = torch.addmm(offsets, middle, normals.T) - half @ normals.abs().T  # of any mean of the box
    reach = boxes.scale * (CUTOFF * (1 + 2 * BOUND_ROUNDING))
    rounding = BOUND_ROUNDING * (half.norm(dim=1) + reach)  # float32 at coordinates far larger than the box
    rounding = rounding + 1e-5 * torch.maximum(boxes.low.abs(), boxes.high.abs()).amax(1) + 1e-5 * offsets.abs().max()
    beyond = nearest[:, :4] <= (share.to(pose) * reach[:, None]) + rounding[:, None]
    return beyond.all(1) & (-nearest[:, 4] > (1 - 2 * BOUND_ROUNDING) * near - rounding)


def _planes(boxes: SplatBoxes, camera: Camera) -> tuple[list[list[float]], Tensor]:
    """Unit normals of the planes through the camera beside the image, pointing away, camera frame; (4,) the share of
    the reach that counts at each."""
    sides = ((camera.fx, camera.cx, camera.width, 0), (camera.fy, camera.cy, camera.height, 1))
    is_blurred = boxes.kind == "gaussian" and boxes.geometry not in ALONG_RAYS
    margin = SPLAT_MARGIN_PX + (CUTOFF * math.sqrt(boxes.dilation) if is_blurred else 0.0)
    normals, shares = [], []
    for focal, principal, pixels, axis in sides:
        edge = HELD_SLOPE_SHARE * pixels / focal
        slope = max(abs(principal / focal + edge), abs((pixels - principal) / focal + edge))
        stretch = focal * math.sqrt(1 + slope**2) if is_blurred else 0.0
        for across, ahead in ((-focal, -margin - principal), (focal, principal - pixels - margin)):
            length = math.hypot(across, ahead)
            normal = [0.0, 0.0, ahead / length]
            normal[axis] = across / length
            normals.append(normal)
            shares.append(stretch / length if is_blurred else 1.0)
    return normals, torch.tensor(shares)


def _blurred(splats: Splats, centre: Tensor, reach: Tensor, camera: Camera, near: float) -> Tensor:
    """The same for footprints by EWA splatting: affine in the covariance, at a slope that is held near the image."""
    x, y, z = centre.unbind(1)
    ahead = z > (1 - BOUND_ROUNDING) * near
    z = torch.where(ahead, z, 1.0)
    more = CUTOFF * math.sqrt(splats.dilation) + SPLAT_MARGIN_PX

    def inside(slope: Tensor, focal: float, principal: float, pixels: int) -> Tensor:
        edge = HELD_SLOPE_SHARE * pixels / focal
        held = slope.clamp(-principal / focal - edge, (pixels - principal) / focal + edge)
        half = focal / z * reach * (1 + held**2).sqrt() + more
        at = focal * slope + principal
        return (at + half >= 0) & (at - half <= pixels)

    across = inside(x / z, camera.fx, camera.cx, camera.width)
    return ahead & across & inside(y / z, camera.fy, camera.cy, camera.height)
