"""Loss terms, by the name users type."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.losses.consensus import Consensus
from surfkit.losses.depth import DepthRegression
from surfkit.losses.frequency import Frequency
from surfkit.losses.normal_prior import NormalPrior
from surfkit.losses.patch_depth import PatchDepth
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.regularizers import MeanOpacity, MeanScale
from surfkit.losses.reprojection import Reprojection
from surfkit.losses.surface import Distortion, NormalConsistency
from surfkit.losses.transients import Robust
from surfkit.losses.warped_patches import WarpedPatches


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    return {
        "l1": L1,
        "ssim": SSIM,
        "normal": NormalConsistency,
        "distortion": Distortion,
        "depth": DepthRegression,
        "patch-depth": PatchDepth,
        "frequency": Frequency,
        "normal-prior": NormalPrior,
        "reprojection": Reprojection,
        "warped-patches": WarpedPatches,
        "mean-opacity": MeanOpacity,
        "mean-scale": MeanScale,
        "consensus": Consensus,
        "robust": Robust,
    }
