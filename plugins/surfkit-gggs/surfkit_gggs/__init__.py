"""Geometry-Grounded Gaussian Splatting (Zhang et al. 2026): Gaussians as stochastic solids."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.appearance.exposure import Exposure
from surfkit.plugin import (
    L1,
    SSIM,
    AbsGradient,
    Component,
    Gaussian3D,
    MatchedADC,
    NormalConsistency,
    Recipe,
    Reprojection,
    Row,
    Stage,
    WarpedPatches,
    hookimpl,
)
from surfkit_gggs.mesher import SolidField, SolidTSDF

GGGS = Recipe(
    about="Ellipsoids with losses between views, and their mesh as stochastic solids (GGGS, Zhang et al. 2026)",
    primitive=Gaussian3D(geometry="solid", smoothing=0.2),
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.05, start=7_000, depth="median"),
            "reprojection": Reprojection(weight=0.02, start=7_000, every=1, depth="median"),
            "patches": WarpedPatches(weight=0.6, start=7_000, every=1, pixels=102_400, depth="median"),
        },
        appearance=Exposure(),
        signal=AbsGradient(),
        densify=MatchedADC(),
    ),
    mesh=SolidField(),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The meshers under the names that recipes use."""
    return {"gggs": SolidField, "gggs-tsdf": SolidTSDF}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The losses and the mesh of the paper."""
    return {"gggs": GGGS}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row in the comparison of methods."""
    return {"methods": (Row("GGGS", recipe=GGGS, kept=False),)}
