"""Ablation tables as values: what each row changes, and the recipe that it gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.registry import offered, offered_once, unknown
from surfkit.core.schedule import rescale
from surfkit.core.tree import evolve
from surfkit.runs.recipe import Recipe, unused, with_steps, without_unused
from surfkit.study.metric_columns import TABLE_COLUMNS

BASELINE = "Without splats"
"""Group of the rows that come last in a table, below those that packages add to it."""


@dataclass(frozen=True)
class Row:
    """A recipe that differs from that of a row above in a few values, or one of its own.

    Attributes:
        label: Its name in the table.
        change: New values, by dotted path into the recipe.
        kept: Later rows build on this one; False for a change that was tried and given up.
        paper: What was published for it, by the names of `surfkit.study.metric_columns`: seconds, bytes and counts as
        such.
        recipe: What is changed; None for that of the row it builds on.
        on: Label of the row above that it builds on, and that it is compared with; None for the last kept one.
        group: Heading of the part of the table that begins with it; "" goes on with the part above. The best values are
            those of each part.
    """

    label: str
    change: Mapping[str, Any] = field(default_factory=dict)
    kept: bool = True
    paper: Mapping[str, float] = field(default_factory=dict)
    recipe: Recipe | None = None
    on: str | None = None
    group: str = ""

    def __post_init__(self) -> None:
        for text in (self.label, self.group):
            if len(text.splitlines()) > 1:
                raise BadInput(f"row {self.label!r}: label and group are one line each")
        for name in self.paper:
            if name not in TABLE_COLUMNS:
                raise BadInput(f"row {self.label!r}, paper: {unknown('column', name, TABLE_COLUMNS)}")

    @property
    def is_given_up(self) -> bool:
        """Whether it is a change that was tried and not kept, rather than a method of its own."""
        return not self.kept and self.recipe is None


@dataclass(frozen=True)
class Table:
    """Rows that are compared, and where they start from.

    Attributes:
        name: As typed, `table:NAME`.
        about: What it shows, in one line.
        base: What the first row changes.
        rows: From top to bottom.
        columns: Names of columns that are shown where they were measured, beside those that every table shows.
    """

    name: str
    about: str
    base: Recipe
    rows: tuple[Row, ...]
    columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.columns:
            if name not in TABLE_COLUMNS:
                raise BadInput(f"table:{self.name}, columns: {unknown('column', name, TABLE_COLUMNS)}")
        labels = [row.label for row in self.rows]
        if twice := [label for label in labels if labels.count(label) > 1]:
            raise BadInput(f"table:{self.name} has two rows {twice[0]!r}; each needs a label of its own")
        for at, row in enumerate(self.rows):
            if row.on is not None and row.on not in labels[:at]:
                raise BadInput(f"table:{self.name}, row {row.label!r}: {unknown('row above', row.on, labels[:at])}")


def offered_tables() -> dict[str, Table]:
    """The tables that packages offer, by name, each with the rows that other packages add to it.

    Raises:
        BadInput: Two packages offer the same table, or the same row of a table.
    """
    tables = offered_once("surfkit_tables", "an ablation table")
    found = dict(tables)
    for owner, name, rows in offered("surfkit_rows"):
        if name not in tables:
            emit(Warned(f"plugin {owner} adds rows to table:{name}, which no package offers; they are left out"))
            continue
        found[name] = with_rows_of_others(found[name], rows, tables[name])
    return found


def with_rows_of_others(table: Table, rows: Sequence[Row], own: Table) -> Table:
    """A table with rows of another package, above its baseline.

    They build on the last kept row of the table's own, or on one another. No other row builds on them: what a row
    trains, and what it is compared with, does not depend on which packages are installed.

    Args:
        table: With the rows of other packages so far.
        rows: To add.
        own: The table as it was offered.
    """
    end = next((at for at, row in enumerate(table.rows) if row.group == BASELINE), len(table.rows))
    before, after, below = table.rows[:end], table.rows[end:], built_on(own)
    ours = {row.label for row in own.rows if row.kept}
    base = next((row.label for row in reversed(before) if row.label in ours), None)
    added, last = [], base
    for row in rows:  # without a row to name, later ones could not be kept from building on a kept one
        added.append(replace(row, on=row.on or last, kept=row.kept and base is not None))
        last = row.label if row.kept else last
    return replace(table, rows=(*before, *added, *(replace(row, on=below[row.label]) for row in after)))


def build(table: Table) -> dict[str, Recipe]:
    """The recipe of every row, by label."""
    recipes: dict[str, Recipe] = {}
    below = built_on(table)
    for row in table.rows:
        recipes[row.label] = with_changes(table, row, recipes.get(below[row.label] or "", table.base))
    return recipes


def with_changes(table: Table, row: Row, base: Recipe) -> Recipe:
    """The recipe of a row that is built on another's.

    Raises:
        BadInput: The row cannot be built.
    """
    recipe = row.recipe or base
    for path, value in row.change.items():
        if path == "test_every":
            told = "rows of a table hold out the same photographs; leave it out, and give surfkit ablate --test-every"
            raise BadInput(f"table:{table.name}, row {row.label!r}: test_every: {told}")
        try:
            recipe = evolve(recipe, path, value)
        except BadInput as error:
            raise BadInput(f"table:{table.name}, row {row.label!r}: {error}") from error
    return replace(settled(recipe, row, table), about=f"{row.label}, a row of table:{table.name}")


def settled(recipe: Recipe, row: Row, table: Table) -> Recipe:
    """The recipe of a row without what its method does not use.

    Raises:
        BadInput: The row itself changes such a setting.
    """
    for path in row.change:
        if path.partition(".")[0] in recipe.unused:
            raise BadInput(f"table:{table.name}, row {row.label!r}: {unused(recipe, path)}")
    return without_unused(recipe)


def built_on(table: Table) -> dict[str, str | None]:
    """The label of the row that each row is built on, by label; None for a first one."""
    found, last = {}, None
    for row in table.rows:
        found[row.label] = row.on or last
        last = row.label if row.kept else last
    return found


def scaled(recipe: Recipe, table: Table, steps: int | None) -> Recipe:
    """A row's recipe when the table's base takes `steps`; a row with a longer or shorter run keeps its share."""
    if steps is None or recipe.length is None:
        return recipe
    share = recipe.length / table.base.length if table.base.length else 1.0
    whole = with_steps(recipe, steps if steps < 1 else max(1, round(steps * share)))
    # The factor of the base is taken as it is: stages after a shorter one would else be a little longer than others'.
    return rescale(recipe, steps / table.base.length) if recipe.has_stages and table.base.length else whole


def limit_points(recipe: Recipe, points: int | None) -> Recipe:
    """The recipe in which no stage adds points beyond a number of them; None sets no limit.

    Each block has the same limit while it is tuned: merged, they may come to more.

    Raises:
        BadInput: The number is below 1.
    """
    if points is None:
        return recipe
    if points < 1:
        raise BadInput(f"--max-points {points}: give 1 or more")
    limited = replace(recipe, start=recipe.start.limited(points))
    for path, stage, _ in recipe.stages():
        if stage.densify is not None:
            limited = evolve(limited, f"{path}.densify", stage.densify.limited(points))
    return limited


def pick(table: Table, names: Sequence[str]) -> list[str]:
    """Labels of the rows that `names` give by label or number, in the order of the table; all if there are none.

    A label comes first: rows may be called 1, 2 and 3 after a setting.
    """
    labels = [row.label for row in table.rows]
    chosen = set()
    for name in names:
        if name in labels:
            chosen.add(name)
        elif name.isdecimal() and 1 <= int(name) <= len(labels):
            chosen.add(labels[int(name) - 1])
        else:
            raise BadInput(f"--rows: {unknown('row', name, labels)}; or give its number, 1 to {len(labels)}")
    return [label for label in labels if label in chosen or not names]
