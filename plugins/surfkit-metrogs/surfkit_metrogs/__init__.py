"""MetroGS: its densification of sparse places, and its loss on large scales (Chen et al. 2026)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    L1,
    SSIM,
    TSDF,
    Component,
    DepthRegression,
    NormalConsistency,
    Recipe,
    Row,
    Stage,
    Surfel2D,
    hookimpl,
)
from surfkit_metrogs.densify import SparsityCompensation
from surfkit_metrogs.losses import LargeScale

# The stage of single views; its second half lacks the refined depth, see README.
METROGS = Recipe(
    about="2DGS with depth from priors that splits large points of sparse places (parts of MetroGS, Chen et al. 2026)",
    primitive=Surfel2D(),
    pretrain=Stage(
        steps=60_000,
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.0125, start=7_000, depth="median"),
            "depth": DepthRegression(start=0.5, end=0.005),
        },
        regularizers={"large": LargeScale()},
        densify=SparsityCompensation(until=15_000),
    ),
    mesh=TSDF(),
)

ROW = "sparsity compensation (MetroGS)"


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {"sparsity": SparsityCompensation, "large-scale": LargeScale}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """What is here of the method."""
    return {"metrogs": METROGS}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its rows among methods and densifiers, and in the table of the surface, on the row that it can add to: the one
    with depth as a loss whose densifier still is ADC."""
    return {
        "methods": (Row("MetroGS", recipe=METROGS, kept=False),),
        "densify": (Row(ROW, {"pretrain.densify": SparsityCompensation()}, kept=False),),
        "surface": (
            Row(
                f"+ {ROW}",
                {"pretrain.densify": SparsityCompensation()},
                kept=False,
                on="+ stereo depth as a loss",
            ),
        ),
    }
