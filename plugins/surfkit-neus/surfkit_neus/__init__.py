"""Neural signed distance functions on hash grids: NeuS (Wang et al. 2021) and Neuralangelo (Li et al. 2023)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, Recipe, Row, hookimpl
from surfkit_neus.method import Neuralangelo, NeuS

RECIPES = {
    "neus": Recipe(
        about="neural signed distance on a hash grid, rendered as a volume with analytic gradients (NeuS)",
        method=NeuS(),
    ),
    "neuralangelo": Recipe(
        about="neural signed distance on a hash grid, coarse to fine with numerical gradients (Neuralangelo)",
        method=Neuralangelo(),
    ),
}


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Both methods."""
    return {"neus": NeuS, "neuralangelo": Neuralangelo}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """Each method by itself."""
    return RECIPES


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Rows of the comparison of methods, with the figures of CityGaussianV2 on GauU-Scene. What has failed there (the
    mesh of NeuS, all of Neuralangelo) has no figure."""
    neus = Row("NeuS", kept=False, recipe=RECIPES["neus"], paper={"psnr": 14.46, "ssim": 0.227, "lpips": 0.688})
    return {"methods": (neus, Row("Neuralangelo", kept=False, recipe=RECIPES["neuralangelo"]))}
