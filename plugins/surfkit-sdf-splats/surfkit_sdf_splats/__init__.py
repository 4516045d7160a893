"""Splats and a neural signed distance function that guide each other: NeuSG (2023) and GSDF (2024)."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit_octree.anchors import Anchors
from surfkit_octree.start import AnchorVoxels

from surfkit.plugin import Component, Gaussian3D, Recipe, Row, hookimpl
from surfkit_sdf_splats.gsdf import GSDF
from surfkit_sdf_splats.neusg import NeuSG

RECIPES = {
    "neusg": Recipe(
        about="flat Gaussians on the zero set of a neural signed distance (NeuSG, Chen et al. 2023)",
        method=NeuSG(),
        primitive=Gaussian3D(),
    ),
    "gsdf": Recipe(
        about="anchors and a neural signed distance that guide each other (GSDF, Yu et al. 2024)",
        method=GSDF(),
        primitive=Anchors(),
        start=AnchorVoxels(levels=1),
    ),
}


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """Both methods."""
    return {"neusg": NeuSG, "gsdf": GSDF}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """Each method by itself."""
    return RECIPES


@hookimpl
def surfkit_rows() -> Mapping[str, tuple[Row, ...]]:
    """Rows of the comparison of methods; CityGaussianV2 has no figures of them."""
    rows = (Row("NeuSG", kept=False, recipe=RECIPES["neusg"]), Row("GSDF", kept=False, recipe=RECIPES["gsdf"]))
    return {"methods": rows}
