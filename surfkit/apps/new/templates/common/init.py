"""A plugin of surfkit: the part, a recipe with it, and an ablation table of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from surfkit.plugin import Component, Recipe, Row, SURFELS, Table, evolve, hookimpl

from .new_part import CHANGE, NewPart


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The part, by the name that recipes and commands use."""
    return {"new-part": NewPart}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The recipe `recipe:new-part`."""
    recipe = replace(SURFELS, about="2DGS with new-part")
    for path, value in CHANGE.items():
        recipe = evolve(recipe, path, value)
    return {"new-part": recipe}


@hookimpl
def surfkit_tables() -> Mapping[str, Table]:
    """The ablation table `table:new-part`: each row is the one before with a change."""
    rows = (Row("2DGS"), Row("+ new-part", CHANGE))
    about = "What new-part changes in 2DGS"
    return {"new-part": Table("new-part", about, SURFELS, rows)}
