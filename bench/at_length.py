"""The paper's tables at a length that a CPU can train: `surfkit ablate bench/at_length.py:model --steps 15000`.

Photographs of 160 pixels are a tenth as wide as the paper's. The published threshold of densification, 2e-4 in units of
half the image, then makes a point of every three pixels (494,000 after 2,000 steps, with 87 photographs of 160 x 107),
where the paper has one of 450. A point of as many pixels has a share of the mean over all pixels that grows as the
image shrinks; thresholds are raised tenfold in every row, which leaves densification going on to its end.

    surfkit ablate bench/at_length.py:gradient --data SCENE --scale 4 --metres-per-unit 1 --steps 15000 --seeds 2 \
        --gt SCENE/gt/mesh.ply --tau 1
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from surfkit.core.tree import evolve
from surfkit.runs.recipe import Recipe
from surfkit.study.ablation import Row, Table, build, built_on, offered_tables
from surfkit.study.recipes.ablations import GRADIENT_TABLE, MODEL_TABLE

RAISED = 10.0


def raised(recipe: Recipe) -> Recipe:
    """The recipe with higher thresholds in all stages that densify by one."""
    for path, stage, _ in recipe.stages() if recipe.has_stages else ():
        densify: Any = stage.densify
        for name in ("threshold", "split_threshold"):
            if (value := getattr(densify, name, None)) is not None:
                recipe = evolve(recipe, f"{path}.densify.{name}", RAISED * value)
    return recipe


def at_length(table: Table) -> Table:
    """The table with the same rows, each with its raised recipe as it is."""
    recipes, below = build(table), built_on(table)
    rows = tuple(
        Row(
            row.label,
            kept=row.kept,
            paper=row.paper,
            recipe=raised(recipes[row.label]),
            on=below[row.label],
            group=row.group,
        )
        for row in table.rows
    )
    return replace(table, base=raised(table.base), rows=rows)


def trimmed() -> Table:
    """Ours-b with the score of the paper and with that of the best view, on the recipe without a trim."""
    recipes = build(MODEL_TABLE)
    ours = recipes["+ trim (Ours-b)"]
    peak = evolve(ours, "tune.prune.0.score", "peak")
    return Table(
        "trim",
        "What a trim costs at length, by the mean over the views of a block and by the best one",
        base=recipes["+ parallel tuning"],
        rows=(Row("no trim"), Row("mean (Ours-b)", recipe=ours, on="no trim"), Row("peak", recipe=peak, on="no trim")),
    )


BEST = ("surface (ours)", "Octree-GS", "Scaffold-GS", "MetroGS", "DOGS", "CityGaussianV2", "CityGaussian", "AbsGS")
"""Of `table:methods` after 1,000 steps, by F1; 2DGS, 3DGS and stereo, which they are compared with, are rows too."""


def methods() -> Table:
    """`table:methods` with its best rows alone."""
    table = offered_tables()["methods"]
    kept = {"2DGS", "3DGS", "stereo alone", *BEST}
    return replace(table, rows=tuple(row for row in table.rows if row.label in kept))


TABLES = {table.name: at_length(table) for table in (GRADIENT_TABLE, MODEL_TABLE, trimmed(), methods())}
