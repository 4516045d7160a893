"""SuGaR: Gaussians that lie on a surface, and its mesh (Guédon and Lepetit 2024)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from surfkit.plugin import ADC, Component, Gaussian3D, LearningRate, Recipe, Row, Stage, hookimpl
from surfkit_sugar.bind import BindToMesh
from surfkit_sugar.bound import AdjacentNormals, BoundMesh, MeshBound
from surfkit_sugar.mesh import LevelSetPoisson
from surfkit_sugar.prune import FaintOnce
from surfkit_sugar.terms import OpacityEntropy, SurfaceField

# 7,000 steps of 3DGS, then 8,000 more; the rate of positions falls as in the first 15,000 of the 30,000 steps of 3DGS.
SUGAR = Recipe(
    about="3DGS whose points are made opaque and flat, then Poisson reconstruction of their density (SuGaR, 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(
        steps=15_000,
        regularizers={"entropy": OpacityEntropy(), "surface": SurfaceField()},
        densify=ADC(until=7_000),
        prune=(FaintOnce(),),
        rates={"means": LearningRate(1.6e-4, 1.6e-5)},
    ),
    mesh=LevelSetPoisson(),
)

REFINED = replace(
    SUGAR,
    about="SuGaR, then flat Gaussians on the triangles of its mesh, optimised together with the vertices",
    refine=(BindToMesh(),),
    mesh=BoundMesh(),
)

PAPER = {"ssim": 0.682, "psnr": 23.47, "lpips": 0.390, "precision": 0.570, "recall": 0.292, "f1": 0.377}
"""Figures of CityGaussianV2, means of three scenes of GauU-Scene."""


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {
        "opacity-entropy": OpacityEntropy,
        "surface-field": SurfaceField,
        "faint-once": FaintOnce,
        "sugar": LevelSetPoisson,
        "mesh-bound": MeshBound,
        "bind-to-mesh": BindToMesh,
        "adjacent-normals": AdjacentNormals,
        "bound": BoundMesh,
    }


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """As published, and without the last phase, the refinement of the mesh."""
    return {"sugar": SUGAR, "sugar-refined": REFINED}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Rows of the comparison of methods, which have the first phases in common."""
    return {
        "methods": (
            Row("SuGaR, not refined", recipe=SUGAR, kept=False),
            Row("SuGaR", recipe=REFINED, kept=False, paper=PAPER),
        )
    }
