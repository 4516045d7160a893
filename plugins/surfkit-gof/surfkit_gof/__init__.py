"""Gaussian Opacity Fields (Yu, Sattler, Geiger 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    L1,
    SSIM,
    AbsGradient,
    Component,
    Distortion,
    Gaussian3D,
    MatchedADC,
    NormalConsistency,
    Recipe,
    Row,
    Stage,
    hookimpl,
)
from surfkit_gof.mesher import OpacityField

GOF = Recipe(
    about="Gaussian Opacity Fields (Yu et al. 2024): ellipsoids with a field of opacities, and its mesh",
    primitive=Gaussian3D(geometry="ray", smoothing=0.2),
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.05, start=15_000, depth="median"),
            "distortion": Distortion(weight=100.0, start=15_000, normalise=True),
        },
        signal=AbsGradient(),
        densify=MatchedADC(),
    ),
    mesh=OpacityField(),
)

# CityGaussianV2's table of GauU-Scene, means of three scenes.
PAPER = {"psnr": 22.33, "ssim": 0.705, "lpips": 0.333, "precision": 0.370, "recall": 0.390, "f1": 0.374}


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The mesher under the name that recipes use."""
    return {"gof": OpacityField}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The method as published."""
    return {"gof": GOF}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row in the comparison of methods."""
    return {"methods": (Row("GOF", recipe=GOF, kept=False, paper=PAPER),)}
