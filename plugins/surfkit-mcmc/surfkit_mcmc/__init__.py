"""3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    L1,
    SSIM,
    TSDF,
    Component,
    Gaussian3D,
    MeanOpacity,
    MeanScale,
    NormalConsistency,
    Recipe,
    Row,
    Stage,
    Surfel2D,
    hookimpl,
)
from surfkit_mcmc.relocation import Relocation

REGULARIZERS = {"opacity": MeanOpacity(weight=0.01), "scale": MeanScale(weight=0.01)}


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The densifier under the name that recipes use."""
    return {"mcmc": Relocation}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """With 3D Gaussians, as published, and with surfels."""
    surface = {"l1": L1(), "ssim": SSIM(), "normal": NormalConsistency(weight=0.05, start=7_000, depth="expected")}
    return {
        "mcmc": Recipe(
            about="3DGS with a fixed number of points that are relocated (3DGS-MCMC, Kheradmand et al. 2024)",
            primitive=Gaussian3D(),
            pretrain=Stage(densify=Relocation(), regularizers=REGULARIZERS),
        ),
        "mcmc-2dgs": Recipe(
            about="2DGS with a fixed number of points that are relocated, as in 3DGS-MCMC",
            primitive=Surfel2D(),
            pretrain=Stage(losses=surface, densify=Relocation(), regularizers=REGULARIZERS),
            mesh=TSDF(),
        ),
    }


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row in the comparison of densifiers."""
    change = {"pretrain.densify": Relocation(), "pretrain.regularizers": REGULARIZERS}
    return {"densify": (Row("relocation (3DGS-MCMC)", change, kept=False),)}
