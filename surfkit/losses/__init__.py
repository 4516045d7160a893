"""Terms of the objective, by the name users type."""

from surfkit.core.registry import hookimpl
from surfkit.losses.depth import DepthRegression
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.regularizers import MeanOpacity, MeanScale
from surfkit.losses.surface import Distortion, NormalConsistency


@hookimpl
def surfkit_components():
    return {
        "l1": L1,
        "ssim": SSIM,
        "normal": NormalConsistency,
        "distortion": Distortion,
        "depth": DepthRegression,
        "mean-opacity": MeanOpacity,
        "mean-scale": MeanScale,
    }
