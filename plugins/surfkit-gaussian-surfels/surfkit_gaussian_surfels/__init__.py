"""GaussianSurfels: ellipsoids without thickness whose normals, depth and priors agree (Dai et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    ADC,
    L1,
    SSIM,
    Component,
    Flat3D,
    NormalPrior,
    PatchMatch,
    Recipe,
    Row,
    Stage,
    hookimpl,
)
from surfkit_gaussian_surfels.losses import BimodalOpacity, NormalCurvature, NormalDepthConsistency
from surfkit_gaussian_surfels.mesh import CutPoisson

GAUSSIAN_SURFELS = Recipe(
    about="Ellipsoids without thickness, normals that agree with depth and with a prior (GaussianSurfels, 2024)",
    primitive=Flat3D(thickness=0.0),
    # Normals of depth maps that are in the data set, as of a network that sees one photograph, or else of stereo.
    depth=PatchMatch(),
    pretrain=Stage(
        steps=15_000,
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal-prior": NormalPrior(start=0.04, end=0.02),
            "consistency": NormalDepthConsistency(),
            "curvature": NormalCurvature(),
        },
        regularizers={"opacity": BimodalOpacity()},
        densify=ADC(until=7_500, cull_opacity=0.1, reset_every=1_000, reset_opacity=0.12),
        quarter_until=2_000,
        half_until=5_000,
    ),
    mesh=CutPoisson(depth="expected"),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {
        "normal-depth-consistency": NormalDepthConsistency,
        "normal-curvature": NormalCurvature,
        "bimodal-opacity": BimodalOpacity,
        "cut-poisson": CutPoisson,
    }


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """As published, for 15,000 steps."""
    return {"gaussian-surfels": GAUSSIAN_SURFELS}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row in the comparison of methods."""
    return {"methods": (Row("GaussianSurfels", recipe=GAUSSIAN_SURFELS, kept=False),)}
