"""MetroGS: its densification of sparse places, and its loss on large scales (Chen et al. 2026)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    L1,
    SSIM,
    TSDF,
    Component,
    DepthRegression,
    LearningRate,
    NormalConsistency,
    Recipe,
    RenderedDepth,
    Row,
    Stage,
    Surfel2D,
    hookimpl,
)
from surfkit_metrogs.densify import SparsityCompensation
from surfkit_metrogs.losses import LargeScale

ROUNDS = 3
"""Times that the depth maps are made again; the paper says "at fixed intervals"."""


def position_rate(done: float, until: float) -> LearningRate:
    """Of 3DGS, whose rate falls to a hundredth along all 60,000 steps, between two shares of them."""
    return LearningRate(1.6e-4 * 100**-done, 1.6e-4 * 100**-until)


def multi_view(index: int) -> RenderedDepth:
    """A round of hybrid multi-view refinement (section 4.3.2, eq. 9 and 10)."""
    shares = [0.5 + 0.5 * at / ROUNDS for at in (index, index + 1)]
    return RenderedDepth(
        stage=Stage(
            steps=30_000 // ROUNDS,
            losses={
                "l1": L1(),
                "ssim": SSIM(),
                "normal": NormalConsistency(weight=0.0125, start=0, depth="median"),
                "depth": DepthRegression(start=2.5, end=2.5),
            },
            densify=None,
            rates={"means": position_rate(*shares)},
        )
    )


METROGS = Recipe(
    about="2DGS with depth from priors that splits large points of sparse places, then learns from depth that stereo "
    "makes of its own (MetroGS, Chen et al. 2026, without its appearance)",
    primitive=Surfel2D(),
    pretrain=Stage(  # single-view optimisation, section 4.3.1
        steps=30_000,
        losses={
            "l1": L1(),
            "ssim": SSIM(),
            "normal": NormalConsistency(weight=0.0125, start=7_000, depth="median"),
            "depth": DepthRegression(start=0.5, end=0.005),
        },
        regularizers={"large": LargeScale()},
        densify=SparsityCompensation(until=15_000),
        rates={"means": position_rate(0.0, 0.5)},
    ),
    refine=tuple(multi_view(index) for index in range(ROUNDS)),
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
