"""A plugin of surfkit: a way to choose the views of blocks, a recipe with it, and an ablation table of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from surfkit.plugin import Component, QuantileGrid, Recipe, Row, SURFELS, Table, hookimpl

from .new_part import NewPart

BLOCKS = replace(SURFELS, partition=QuantileGrid(blocks=(2, 1)), tune=SURFELS.pretrain)
RECIPE = replace(BLOCKS, about="2DGS in two blocks, with new-part", assign=NewPart())


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The part, by the name that recipes use."""
    return {"new-part": NewPart}


@hookimpl
def surfkit_recipes() -> Mapping[str, Recipe]:
    """The recipe `recipe:new-part`."""
    return {"new-part": RECIPE}


@hookimpl
def surfkit_tables() -> Mapping[str, Table]:
    """The ablation table `table:new-part`: each row is the one before with a change."""
    rows = (Row("2DGS in blocks"), Row("+ new-part", {"assign": NewPart()}))
    about = "What new-part changes in 2DGS with two blocks"
    return {"new-part": Table("new-part", about, BLOCKS, rows)}
