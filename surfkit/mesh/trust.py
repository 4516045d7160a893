"""Weights of the pixels of depth maps: by their own view, and by what other views see in the same place."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor

from surfkit.core.registry import Component
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh.overlap import Depths
from surfkit.raster.api import Maps


class Trust(Component):
    """A factor for the weight of each pixel when depth maps are fused; 0 leaves the pixel out.

    A pixel that is left out also clears nothing of what lies before it.
    """

    @property
    def needs_prior(self) -> bool:
        """Whether `within` looks at depth priors, where there are any."""
        return False

    @abstractmethod
    def within(self, maps: Maps, depth: Tensor, prior: DepthPrior | None) -> Tensor:
        """(H, W) 0 or more, from the view itself.

        Args:
            maps: Of the view.
            depth: (H, W) camera z that is to be fused, 0 for none.
            prior: Of the view, where there is one.
        """

    @abstractmethod
    def among(self, at: int, depths: Depths) -> Tensor:
        """(H, W) 0 or more, from what other views show of the depths of the view at a position.

        Depths that `within` left out are 0 in every view.
        """
