"""How far a pixel of a depth map may be trusted: what its own view says, and what other views see in the same place."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor

from surfkit.core.registry import Component
from surfkit.mesh.overlap import Depths
from surfkit.raster.api import Maps
from surfkit.readers.depth_prior import DepthPrior


class Trust(Component):
    """What the weight of each pixel is multiplied with when depth maps are fused; 0 leaves the pixel out.

    A pixel that is left out also clears nothing of what lies before it.
    """

    @property
    def needs_prior(self) -> bool:
        """Whether `within` looks at depth priors, where there are any."""
        return False

    @abstractmethod
    def within(self, maps: Maps, depth: Tensor, prior: DepthPrior | None) -> Tensor:
        """(H, W) 0 or more, by what the view itself tells.

        Args:
            maps: Of the view.
            depth: (H, W) camera z that is to be fused, 0 for none.
            prior: Of the view, where there is one.
        """

    @abstractmethod
    def among(self, at: int, depths: Depths) -> Tensor:
        """(H, W) 0 or more, by what other views tell of the depths of the view at a position.

        Depths that `within` left out are 0 in every view.
        """
