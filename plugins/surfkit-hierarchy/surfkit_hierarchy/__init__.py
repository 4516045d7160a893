"""Hierarchical 3D Gaussians (Kerbl et al. 2024): a scaffold, chunks, and a tree of splats cut by size on the screen."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import (
    L1,
    SSIM,
    AdamInView,
    Component,
    DepthRegression,
    Exposure,
    Gaussian3D,
    Hierarchy,
    LearningRate,
    Recipe,
    Row,
    SparsePointShare,
    SquareGrid,
    Stage,
    hookimpl,
)
from surfkit_hierarchy.peak_adc import PeakADC

__all__ = ["HIERARCHICAL", "PeakADC"]

LOSSES = {"l1": L1(), "ssim": SSIM(), "depth": DepthRegression(start=1.0, end=0.01, depth="expected")}
LIGHT = Exposure(start=1e-3, end=1e-4)

SCAFFOLD = Stage(
    losses={"l1": L1(), "ssim": SSIM()},
    densify=None,
    appearance=LIGHT,
    rates={"means": LearningRate(0.0)},
    sh_every=15_001,  # so that the whole stage has one degree more than the constant at most
    optimizer=AdamInView(),
)
CHUNK = Stage(
    losses=LOSSES,
    densify=PeakADC(),
    appearance=LIGHT,
    rates={"means": LearningRate(2e-5, 2e-7)},
    optimizer=AdamInView(),
)
HIERARCHICAL = Recipe(
    about="A scaffold, chunks, and a tree of splats cut by size on the screen (Hierarchical 3DGS, Kerbl et al. 2024)",
    primitive=Gaussian3D(),
    pretrain=SCAFFOLD,
    partition=SquareGrid(),
    assign=SparsePointShare(),
    min_views=101,
    tune=CHUNK,
    context="frozen",
    lod=Hierarchy(),
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The densifier; chunks, their views, exposures and the tree are surfkit's own."""
    return {"peak-adc": PeakADC}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The method."""
    return {"hierarchical-3dgs": HIERARCHICAL}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row in the comparison of methods."""
    return {"methods": (Row("Hierarchical 3DGS", recipe=HIERARCHICAL, kept=False),)}
