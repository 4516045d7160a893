"""The depth that a model draws, made better by stereo, and what training learns from it (MetroGS, section 4.3.2)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from surfkit.core.check import BadInput
from surfkit.core.registry import choice, name_of
from surfkit.core.schedule import LearningRate
from surfkit.depth.base import DepthEstimator
from surfkit.depth.patch_match import PatchMatch
from surfkit.losses.depth import DepthRegression
from surfkit.losses.photometric import L1, SSIM
from surfkit.train.refine.base import Refine
from surfkit.train.stage import Stage


@dataclass(frozen=True)
class RenderedDepth(Refine):
    """Train on with depth maps that stereo makes from the depth which the model draws (MetroGS, CVPR 2026).

    Stereo begins at the median depth and the normals that the model draws of each training photograph, and keeps what
    photographs and neighbouring depth maps confirm. Splats know places that few photographs show, stereo knows what
    matches: together they are right more often than either. Several in a row make the maps again in between.
    """

    depth: Annotated[DepthEstimator, choice(DepthEstimator)] = field(default_factory=PatchMatch)
    """What makes the maps. It must be one that can begin at a known depth: patch-match, or filled around it."""

    stage: Stage = field(
        default_factory=lambda: Stage(
            steps=10_000,
            losses={"l1": L1(), "ssim": SSIM(), "depth": DepthRegression(start=2.5, end=2.5)},
            densify=None,
            rates={"means": LearningRate(1.6e-5, 1.6e-6)},
        )
    )
    """The optimisation; losses on depth compare with these maps."""

    def __post_init__(self) -> None:
        if not self.depth.continues:
            raise BadInput(
                f"rendered-depth.depth is {name_of(self.depth)}, which cannot begin at the depth that a model draws; "
                "choose patch-match, or filled with patch-match"
            )
        if not any(loss.needs_prior for loss in self.stage.losses.values()):
            raise BadInput(
                "rendered-depth.stage.losses: none of them looks at depth maps, which would be made in vain; add "
                "stage.losses.depth:depth, or leave the refinement out"
            )

    @property
    def estimator(self) -> DepthEstimator:
        """See `Refine.estimator`."""
        return self.depth
