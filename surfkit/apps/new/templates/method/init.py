"""A plugin of surfkit: a method, a recipe with it, and an ablation table that compares it with 2DGS."""

from __future__ import annotations

from collections.abc import Mapping

from surfkit.plugin import Component, Recipe, Row, SURFELS, Table, hookimpl

from .new_part import NewPart

RECIPE = Recipe(about="A mesh by new-part", method=NewPart())


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The method, by the name that recipes use."""
    return {"new-part": NewPart}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The recipe `recipe:new-part`."""
    return {"new-part": RECIPE}


@hookimpl
def surfkit_tables() -> Mapping[str, Table]:
    """The ablation table `table:new-part`; `surfkit_rows` would add the row to a table of another package."""
    rows = (Row("2DGS"), Row("new-part", recipe=RECIPE))
    about = "2DGS and new-part"
    return {"new-part": Table("new-part", about, SURFELS, rows)}
