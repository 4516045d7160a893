"""What fills the pixels of a depth map that stereo trusts nothing of."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from surfkit.core.registry import Component
from surfkit.depth.base import DepthInput
from surfkit.depth.cost_volume import ray_map
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

MIN_FITTING_SHARE = 0.8
"""Share of the trusted pixels beside a hole that what fills it must fit."""
SEEN_THROUGH = "other views see through what would fill them"
"""Why pixels are left empty that a fill has filled."""
FREE_SPACE_MARGIN = 0.01
"""What lies nearer to another camera than trusted depth there, by this share of it, lies in space that is free."""


@dataclass(frozen=True)
class FillInput:
    """A depth map with holes. All sizes are those of the map.

    Attributes:
        at: Position of the view.
        photo: (3, h, w) float32 in [0, 1].
        camera: Of the map.
        inverse: (h, w) float32 inverse camera z, 1/local units, where stereo is trusted; 0 elsewhere.
        trust: (h, w) float32 in [0, 1], the confidence there; 0 elsewhere.
        others: Cameras and trusted inverse depths, 0 elsewhere, of views that show the same.
        tell: Takes why pixels are left empty, in a few words, and how many; users see the shares of all maps.
    """

    at: int
    photo: Tensor
    camera: Camera
    inverse: Tensor
    trust: Tensor
    others: Sequence[tuple[Camera, Tensor]] = ()
    tell: Callable[[str, int], None] = lambda why, pixels: None

    @cached_property
    def holes(self) -> Tensor:
        """(h, w) bool, the pixels to fill."""
        return self.inverse <= 0

    def is_free(self, inverse: Tensor) -> Tensor:
        """(h, w) bool, whether more of the other views see through a place than see a surface there.

        A view sees through a place if its trusted depth there is larger, by more than `FREE_SPACE_MARGIN`; where it is
        smaller, the place is hidden from it and it says nothing.

        Args:
            inverse: (h, w) inverse depth of the places; 0 for none.
        """
        through, met = torch.zeros_like(inverse), torch.zeros_like(inverse)
        for there, other in self.others:
            a, b = ray_map(self.camera, there, inverse.device)
            x, y, z = (a[i] + inverse * b[i] for i in range(3))
            grid = torch.stack([x / z * (2 / there.width) - 1, y / z * (2 / there.height) - 1], -1)
            found = grid_sample(other[None, None], grid[None], mode="nearest", align_corners=False)[0, 0]
            ratio = found * z / inverse.clamp_min(1e-20)  # depth of the place / depth found
            known = (inverse > 0) & (z > 0) & (found > 0)
            through += known & (ratio < 1 - FREE_SPACE_MARGIN)
            met += known & ((ratio - 1).abs() <= FREE_SPACE_MARGIN)
        return through > met


class Fill(Component):
    """A way to fill the pixels of a depth map that stereo trusts nothing of.

    What it gives is looked at once more: pixels that other views see through are left empty, and filled ones have a low
    confidence.
    """

    @abstractmethod
    def opened(self, given: DepthInput, wanted: Sequence[int]) -> Callable[[FillInput], Tensor]:
        """What gives (h, w) float32 inverse depth for a map with holes, 0 where nothing fits; only holes are looked at.

        Called once; what it returns, for some of the views at the positions `wanted`, in this order.

        Raises:
            BadInput: What it needs is not there.
        """

    def files(self, views: Sequence[View]) -> tuple[Path, ...]:
        """See `DepthEstimator.files`."""
        return ()

    def refuse_missing(self) -> None:
        """See `DepthEstimator.refuse_missing`."""
        return None

    def notice(self) -> str | None:
        """See `DepthEstimator.notice`."""
        return None
