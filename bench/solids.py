"""What the depth of stochastic solids changes in training: rows for `surfkit ablate bench/solids.py:solids`.

    surfkit ablate bench/solids.py:solids --data SCENE --scale 4 --metres-per-unit 1 --test-every 8 --steps 1500 \
        --max-points 30000 --gt SCENE/gt/mesh.ply --tau 1

The losses of geometry begin at step 400, as they would not begin in so few steps. All meshes are of depth maps, made in
one way within each of the two groups.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from surfkit_gggs import GGGS

from surfkit.core.tree import evolve
from surfkit.mesh.tsdf import TSDF
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.runs.recipe import Recipe
from surfkit.study.ablation import Row, Table
from surfkit.study.recipes.surface_recipes import SURFACE

BEGIN = 400

Depth = Literal["median", "expected"]


def gggs(geometry: Literal["ray", "solid"], between: Depth) -> Recipe:
    """recipe:gggs with another geometry, and another depth in the losses between views."""
    recipe = replace(GGGS, primitive=replace(GGGS.primitive, geometry=geometry), mesh=TSDF())
    for name, depth in (("normal", "median"), ("reprojection", between), ("patches", between)):
        recipe = evolve(recipe, f"pretrain.losses.{name}.depth", depth)
        recipe = evolve(recipe, f"pretrain.losses.{name}.start", BEGIN)
    return recipe


def surface(geometry: Literal["ray", "solid"], first_thickness: float = 1.0, smoothing: float = 0.2) -> Recipe:
    """recipe:surface of ellipsoids, which begin as balls or thinner."""
    primitive = Gaussian3D(sh_degree=1, geometry=geometry, smoothing=smoothing, first_thickness=first_thickness)
    return replace(SURFACE, primitive=primitive)


TABLES = {
    "solids": Table(
        "solids",
        "Ellipsoids with the expected depth, the median one, and that of stochastic solids",
        base=gggs("ray", "expected"),
        rows=(
            Row("GGGS, expected depth of splatting between views"),
            Row("GGGS, median depth of splatting", recipe=gggs("ray", "median")),
            Row("GGGS", recipe=gggs("solid", "median")),
            Row("surface (discs)", recipe=SURFACE),
            Row("surface, ellipsoids", recipe=surface("ray"), on="surface (discs)"),
            Row("surface, solids", recipe=surface("solid"), on="surface, ellipsoids"),
            Row("surface, solids that begin thin", recipe=surface("solid", 0.1), on="surface, solids"),
            Row("surface, solids that begin thinner", recipe=surface("solid", 0.02), on="surface, solids"),
            Row("surface, thin solids without smoothing", recipe=surface("solid", 0.1, 0), on="surface (discs)"),
            Row("surface, solids of a third without smoothing", recipe=surface("solid", 0.3, 0), on="surface (discs)"),
            Row("surface, thin ellipsoids without smoothing", recipe=surface("ray", 0.1, 0), on="surface (discs)"),
        ),
    )
}
