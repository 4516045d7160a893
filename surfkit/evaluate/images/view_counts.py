"""How many training views see what each pixel of a held-out photograph shows, and how good the pixels are by that."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surfkit.core.events import Progress, emit
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

COMPARED_LONGEST_PX = 800
"""Of the depth maps that are compared; larger photographs are looked at so."""
BATCH_BYTES = 512 << 20
"""Of the places that pixels show, in memory at a time; for more photographs, training views are drawn again."""
PLACE_BYTES = 16
DEPTH_SLACK_PX = 2.0
"""Widths of a pixel by which depths may differ."""

DepthOf = Callable[[View], Tensor]
"""(H, W) float32 camera z of what a view shows, local units, at the size of its camera; 0 where there is nothing."""


@dataclass(frozen=True)
class DepthSource:
    """Where depth comes from, and when two views show the same place.

    Attributes:
        of: The depth of a view.
        source: What made it, for people.
        tolerance: Share of the depth by which a training view's own may differ; two widths of a pixel if that is more.
        through: Whether a place in front of what the training view shows counts as seen: so for a true surface, of
            which only what lies in front can hide something; not for rendered depth, which must agree.
    """

    of: DepthOf
    source: str
    tolerance: float
    through: bool


@dataclass(frozen=True)
class ViewCounts:
    """What a held-out photograph shows.

    Attributes:
        view: The photograph.
        places: (h, w, 3) float32 local frame, of a picture up to 800 pixels long; NaN where there is no depth.
        counts: (h, w) int32 training views that see the place; 0 where there is none.
    """

    view: View
    places: Tensor
    counts: Tensor

    def full(self, mask: Tensor) -> Tensor:
        """(H, W) bool at the size of the photograph, of one at the size of the counts."""
        size = (self.view.camera.height, self.view.camera.width)
        return torch.nn.functional.interpolate(mask[None, None].float(), size=size, mode="nearest")[0, 0] > 0.5


def count_views(held_out: Sequence[View], train: Sequence[View], depths: DepthSource) -> Iterator[ViewCounts]:
    """What each held-out photograph shows, and how many training views see it.

    A place counts as seen if it lies in a training view's picture, and the depth there, of the nearest pixel or between
    the four around, agrees.

    Args:
        held_out: Views to ask about.
        train: Views that see; their depth is asked for again for every 512 MB of places.
        depths: Where depth comes from.
    """
    sizes = [PLACE_BYTES * reduced(view).camera.width * reduced(view).camera.height for view in held_out]
    batches: list[list[View]] = []
    for view, at in zip(held_out, np.cumsum(sizes) // BATCH_BYTES, strict=True):
        while len(batches) <= at:
            batches.append([])
        batches[at].append(view)
    batches = [batch for batch in batches if batch]
    for number, batch in enumerate(batches):
        found = [ViewCounts(view, *_places(view, depths.of)) for view in batch]
        for done, view in enumerate(train, 1):
            small = reduced(view)
            depth = depths.of(small)
            for counted in found:
                counted.counts.add_(_seen(counted.places, small.camera, depth, depths))
            emit(Progress("counting the views of each pixel", number * len(train) + done, len(batches) * len(train)))
        yield from found


def reduced(view: View) -> View:
    """The view at the size at which depths are compared."""
    return replace(view, camera=view.camera.fitted(COMPARED_LONGEST_PX))


def _places(view: View, depth_of: DepthOf) -> tuple[Tensor, Tensor]:
    """(h, w, 3) places that the pixels show, and counts of 0."""
    small = reduced(view)
    depth, pose = depth_of(small).cpu().double(), small.camera.world_to_camera
    there = (depth > 0) & depth.isfinite()
    local = small.camera.rays(torch.float64) * torch.where(there, depth, torch.nan)
    places = (local.permute(1, 2, 0) - pose[:3, 3]) @ pose[:3, :3]
    return places.float(), torch.zeros(depth.shape, dtype=torch.int32)


def _seen(places: Tensor, camera: Camera, depth: Tensor, depths: DepthSource) -> Tensor:
    """(h, w) bool: which places a training view sees.

    On a plane, the inverse depth is linear in the picture: between pixels it is exact there.
    """
    pose = camera.world_to_camera.float()
    x, y, z = (places @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    x, y = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    depth = depth.cpu().float()
    inverse = torch.where((depth > 0) & depth.isfinite(), 1 / depth, 0.0)[None, None]
    at = torch.stack([2 * x / camera.width - 1, 2 * y / camera.height - 1], -1)[None].nan_to_num(-2.0).clamp(-2, 2)
    slack = max(depths.tolerance, DEPTH_SLACK_PX / max(camera.fx, camera.fy))
    agrees = torch.zeros_like(inside)
    for way in ("nearest", "bilinear"):
        ratio = (
            z * torch.nn.functional.grid_sample(inverse, at, mode=way, padding_mode="border", align_corners=False)[0, 0]
        )
        agrees |= (ratio < 1 + slack) & (depths.through | (ratio > 1 - slack))
    return inside & agrees
