"""Recipes by name."""

from collections.abc import Mapping

from surfkit.core.registry import hookimpl
from surfkit.densify.adc import ADC
from surfkit.losses.photometric import L1, SSIM
from surfkit.losses.surface import Distortion, NormalConsistency
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.recipe import Recipe
from surfkit.train.stage import Stage

GAUSSIANS = Recipe(
    about="3D Gaussian splatting (Kerbl et al. 2023): the sharpest pictures, no usable surface",
    primitive=Gaussian3D(),
)

SURFELS = Recipe(
    about="2D Gaussian splatting (Huang et al. 2024): flat discs that make clean surfaces",
    primitive=Surfel2D(),
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.05, start=7_000, depth="expected"),
            "distortion": Distortion(weight=0.0, start=3_000),
        },
        densify=ADC(cull_opacity=0.05),
    ),
)


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The recipes of surfkit."""
    return {"2dgs": SURFELS, "3dgs": GAUSSIANS}
