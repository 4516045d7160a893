"""Self-Organizing Gaussians: splats that are sorted into a smooth picture, trained and stored so (ECCV 2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, Gaussian3D, Recipe, Row, Stage, hookimpl
from surfkit_self_organizing.format import GridSOG
from surfkit_self_organizing.smooth import SmoothGrid

SELF_ORGANIZING = Recipe(
    about="3DGS whose points are alike where they are neighbours in a grid (Self-Organizing Gaussians, 2024)",
    primitive=Gaussian3D(),
    pretrain=Stage(regularizers={"smooth": SmoothGrid()}),
    tune=Stage(regularizers={"smooth": SmoothGrid()}),  # where the scene is cut
)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Its parts, by the names that recipes use."""
    return {"grid-sog": GridSOG, "smooth-grid": SmoothGrid}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The method."""
    return {"self-organizing": SELF_ORGANIZING}


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Its row among methods."""
    return {"methods": (Row("Self-Organizing Gaussians", recipe=SELF_ORGANIZING, kept=False),)}
