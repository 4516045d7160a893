"""Photographs at a fraction of their size, which early steps may look at: they are drawn faster, and have no detail
that splats are too large for yet."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, normalize

from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.losses.base import Target
from surfkit.scene.camera import Camera

MIN_SIDE_PX = 32
"""No photograph is made smaller than this on its shorter side: windows of losses would cover most of it."""
MIN_MASK_SHARE = 0.75
"""Share of the pixels of a block that count, from which the block does."""
MAX_DEPTH_SPREAD = 0.05
"""Largest difference of inverse depths in a block, as a share of their mean; beyond it the block is at an edge."""


def divisor_for(camera: Camera, divisor: int) -> int:
    """`divisor`, or half of it and so on where the photograph of a camera would become smaller than MIN_SIDE_PX."""
    while divisor > 1 and min(camera.width, camera.height) // divisor < MIN_SIDE_PX:
        divisor //= 2
    return divisor


def smaller_camera(camera: Camera, divisor: int) -> Camera:
    """The camera whose pixels are blocks of `divisor` x `divisor`; columns and rows that fill no block are left out."""
    fx, fy, cx, cy = (value / divisor for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=camera.width // divisor, height=camera.height // divisor)


def smaller(target: Target, divisor: int) -> Target:
    """The target with blocks of `divisor` x `divisor` pixels as pixels. It has no second view yet.

    A block has the mean colour of its pixels that count, and counts where MIN_MASK_SHARE of them do.
    """
    if (divisor := divisor_for(target.view.camera, divisor)) == 1:
        return target
    photo, mask = avg_pool2d(target.photo, divisor), None
    if target.mask is not None:
        keep = target.mask.to(target.photo)[None]
        share = avg_pool2d(keep, divisor)
        photo = torch.where(share > 0, avg_pool2d(target.photo * keep, divisor) / share, photo)
        mask = share[0] >= MIN_MASK_SHARE
    return replace(
        target,
        view=replace(target.view, camera=smaller_camera(target.view.camera, divisor)),
        photo=photo,
        mask=mask,
        prior=None if target.prior is None else smaller_prior(target.prior, divisor),
    )


def smaller_prior(prior: DepthPrior, divisor: int) -> DepthPrior:
    """The prior with blocks as pixels: means, where all pixels of a block are known and none lies behind an edge.

    On a plane inverse depth is linear in the picture, so that the mean is right at the middle of the block.
    """
    inverse, normal = avg_pool2d(prior.inverse[None], divisor)[0], prior.normal
    spread = max_pool2d(prior.inverse[None], divisor)[0] + max_pool2d(-prior.inverse[None], divisor)[0]
    known = every(prior.inverse > 0, divisor) & (spread <= MAX_DEPTH_SPREAD * inverse)
    confidence = avg_pool2d(prior.confidence[None], divisor)[0]
    if normal is not None:
        there = every((normal != 0).any(0), divisor)
        normal = torch.where(there, normalize(avg_pool2d(normal, divisor), dim=0), 0)
    return replace(
        prior, inverse=torch.where(known, inverse, 0), confidence=torch.where(known, confidence, 0), normal=normal
    )


def every(values: Tensor, divisor: int) -> Tensor:
    """(H / divisor, W / divisor) bool, whether all of a block are True, of (H, W) bool."""
    return ~max_pool2d((~values).to(torch.float32)[None], divisor)[0].bool()
