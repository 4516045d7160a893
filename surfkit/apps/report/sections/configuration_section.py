"""The settings of each run, and in which of them runs differ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from surfkit.apps.report.elements import Details, Element, Prose, Section, TableCell, TableElement
from surfkit.apps.report.json_values import NO_VALUE, flat, in_words, mapping, plain
from surfkit.apps.report.run_files import RunFiles


def configuration(runs: Sequence[RunFiles]) -> Section:
    """What differs first, then all settings of each run."""
    elements: list[Element] = []
    if len(runs) > 1:
        elements.append(_differences(runs))
    for run in runs:
        if isinstance(about := run.recipe.get("about"), str) and about:
            elements.append(Prose(about if len(runs) == 1 else f"{run.name}: {about}"))
        rows = tuple(plain(TableCell(path), in_words(value)) for path, value in settings(run).items())
        table = TableElement(f"Settings of {run.name}", ("setting", "value"), rows)
        elements.append(Details(f"All {len(rows)} settings of {run.name}", (table,)))
    return Section("configuration", "Configuration", tuple(elements))


def settings(run: RunFiles) -> dict[str, Any]:
    """The recipe and the data set by dotted path, as on the command line."""
    recipe = {key: value for key, value in run.recipe.items() if key not in ("about", "test_every")}
    return {path: value for path, value in (flat(recipe) | flat(mapping(run.record, "data"), "data")).items() if path}


def _differences(runs: Sequence[RunFiles]) -> Element:
    every = [settings(run) for run in runs]
    paths = list(dict.fromkeys(path for one in every for path in one))
    rows = []
    for path in paths:
        shown = [in_words(one[path]) if path in one else NO_VALUE for one in every]
        if len(set(shown)) > 1:
            rows.append((TableCell(path), *map(TableCell, shown)))
    if not rows:
        return Prose("All settings of the runs are equal.")
    return TableElement("Settings that differ between the runs", ("setting", *(run.name for run in runs)), tuple(rows))
