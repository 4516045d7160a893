"""The sky, which splats paint at any distance: above the horizon, what no depth map knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from surfkit.core.events import Warned, emit
from surfkit.io.datasets.depth_prior import MIN_KNOWN_CONFIDENCE
from surfkit.mesh.base import MeshInput
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.scene.up_direction import up_of_views

BIN_PX = 2.0
"""Width of the strips of the picture from the horizon to the zenith, pixels at the middle of the picture."""


def without_sky(subject: MeshInput) -> MeshInput:
    """What is to be meshed, without the pixels that show the sky, where depth maps and cameras can tell.

    Told if they cannot, as there are no depth maps, or the cameras do not tell which way is up.
    """
    up = up_of_views(subject.views, subject.frame)
    if up is not None and not may_show_sky(subject.views, up):
        return subject
    if subject.priors is None or up is None:
        why = "the cameras do not tell which way is up" if up is None else "there are no depth maps"
        emit(Warned(f"sky that the photographs may show stays in the mesh, as {why}; masks leave it out"))
        return subject
    priors = subject.priors

    def keep(at: int) -> Tensor | None:
        mask, prior = subject.keep(at), priors[at]
        if prior is None:
            return mask
        solid = ~sky(subject.views[at].camera, prior.confidence >= MIN_KNOWN_CONFIDENCE, up)
        return solid if mask is None else mask & solid

    return replace(subject, keep=keep)


def may_show_sky(views: Sequence[View], up: np.ndarray | None) -> bool:
    """Whether any picture reaches above the horizon, and so has a corner there; not if nobody knows which way is up."""
    return up is not None and any((_corners(view.camera) @ up > 0).any() for view in views)


def _corners(camera: Camera) -> np.ndarray:
    """(4, 3) rays through the corners of the picture, local axes."""
    x, y = np.repeat([0, camera.width], 2), np.tile([0, camera.height], 2)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(4)], 1)
    return rays @ camera.world_to_camera[:3, :3].numpy()


def sky(camera: Camera, known: Tensor, up: np.ndarray) -> Tensor:
    """(H, W) bool: above the horizon, and above all that is known in the same direction of the compass.

    Args:
        camera: Of the picture.
        known: (H, W) bool, pixels whose depth is known.
        up: (3,) unit vector, local frame.
    """
    rays = np.einsum("ji,jhw->ihw", camera.world_to_camera[:3, :3].numpy(), camera.rays(torch.float64).numpy())
    rise = np.einsum("i,ihw->hw", up, rays) / np.linalg.norm(rays, axis=0)  # sine of the elevation
    if (rise <= 0).all():
        return torch.zeros(known.shape, dtype=torch.bool)
    across = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    across /= np.linalg.norm(across)
    compass = np.arctan2(*(np.einsum("i,ihw->hw", axis, rays) for axis in (across, np.cross(up, across))))
    strip = np.floor((compass + np.pi) * (camera.fx / BIN_PX)).astype(np.int64)
    highest = np.zeros(strip.max() + 1)
    solid = known.numpy()
    np.maximum.at(highest, strip[solid], rise[solid])
    return torch.from_numpy(rise > highest[strip])
