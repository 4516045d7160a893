"""RaDe-GS: rasterized depth and normals of ellipsoids (Zhang et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    L1,
    SSIM,
    TSDF,
    AbsGradient,
    Gaussian3D,
    MatchedADC,
    NormalConsistency,
    Recipe,
    Row,
    Stage,
    hookimpl,
)

WEIGHT, OF_EXPECTED = 0.05, 0.4
"""Weight of both normal terms together, and the share of that of the expected depth."""

RADEGS = Recipe(
    about="3DGS whose normals agree with its expected and its median depth (RaDe-GS, Zhang et al. 2024)",
    primitive=Gaussian3D(geometry="plane", smoothing=0.2),
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=WEIGHT * OF_EXPECTED, start=15_000, depth="expected"),
            "normal-median": NormalConsistency(weight=WEIGHT * (1 - OF_EXPECTED), start=15_000, depth="median"),
        },
        signal=AbsGradient(),
        densify=MatchedADC(),
    ),
    mesh=TSDF(),
)


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The method, with surfkit's own mesh."""
    return {"radegs": RADEGS}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row in the comparison of methods."""
    return {"methods": (Row("RaDe-GS", recipe=RADEGS, kept=False),)}
