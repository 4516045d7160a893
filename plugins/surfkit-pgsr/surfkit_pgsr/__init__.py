"""PGSR: planar Gaussians with unbiased depth and multi-view losses (Chen et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import L1, SSIM, AbsGradient, Component, Recipe, Reprojection, Row, Stage, WarpedPatches, hookimpl
from surfkit_pgsr.densify import FewViews, TwoThresholdADC
from surfkit_pgsr.exposure import GainOffset
from surfkit_pgsr.losses import EdgeAwareNormal, MeanThickness
from surfkit_pgsr.mesh import MaxAngleTSDF
from surfkit_pgsr.planes import PlanarGaussian

PGSR = Recipe(
    about="Flat Gaussians with the depth of their planes and losses between views (PGSR, Chen et al. 2024)",
    primitive=PlanarGaussian(),
    pretrain=Stage(
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": EdgeAwareNormal(weight=0.015, start=7_000),
            "reprojection": Reprojection(weight=0.03, start=7_000, every=1),
            "patches": WarpedPatches(weight=0.15, start=7_000, every=1, pixels=102_400),
        },
        regularizers={"thickness": MeanThickness(weight=100.0)},
        appearance=GainOffset(),
        signal=AbsGradient(),
        densify=TwoThresholdADC(),
        prune=(FewViews(),),
    ),
    mesh=MaxAngleTSDF(),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {
        "planar-gaussian": PlanarGaussian,
        "edge-aware-normal": EdgeAwareNormal,
        "mean-thickness": MeanThickness,
        "gain-offset": GainOffset,
        "two-threshold-adc": TwoThresholdADC,
        "few-views": FewViews,
        "max-angle-tsdf": MaxAngleTSDF,
    }


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """As published, for 30,000 steps."""
    return {"pgsr": PGSR}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Rows of the comparison of methods, where CityGaussianV2 has no figures for it, and of appearances."""
    return {
        "methods": (Row("PGSR", recipe=PGSR, kept=False),),
        "appearance": (Row("gain and offset", {"pretrain.appearance": GainOffset()}, kept=False),),
    }
