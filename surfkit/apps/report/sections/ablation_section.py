"""An ablation table: its rows with their differences, and what each row changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surfkit.apps.report.elements import Element, Prose, Section, TableCell, TableElement
from surfkit.apps.report.json_values import (
    NO_VALUE,
    QUANTITIES,
    in_words,
    mapping,
    number,
    numeric,
    plain,
    quantity,
    value_at,
)
from surfkit.apps.report.run_files import RunFiles, read_source
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.study.table_text import distinct_names

ABLATION_FILE = "ablation.json"
CAPTION = (
    "Means over the seeds ± standard deviation. Below them is the difference to the row that a row is built on, ± its "
    "standard error. Rows in brackets were tried and given up; later rows do not build on them."
)


Place = tuple[int, int]
"""Positions of a data set in a table and of a row."""


def read_table(folder: Path) -> dict[str, Any]:
    """What `surfkit ablate` has written.

    Raises:
        BadInput: It is damaged.
    """
    report = read_json(folder / ABLATION_FILE, dict[str, Any])
    entries = report.get("data_sets")
    if not isinstance(entries, list) or not entries or not all(_has_rows(entry) for entry in entries):
        raise BadInput(
            f"{folder / ABLATION_FILE}: data_sets is no list of data sets, each with rows that have labels; give the "
            f"surfkit "
            "ablate command again"
        )
    return report


def _has_rows(entry: Any) -> bool:
    rows = value_at(entry, "rows")
    return isinstance(rows, list) and all(isinstance(value_at(row, "label"), str) for row in rows)


def data_set_names(report: Mapping[str, Any]) -> list[str]:
    """What the data sets are called where there are several; "" for the only one."""
    paths = [value_at(entry, "data", "path") for entry in report["data_sets"]]
    return distinct_names([path if isinstance(path, str) else "" for path in paths]) if len(paths) > 1 else [""]


def row_runs(folder: Path, report: Mapping[str, Any]) -> dict[Place, RunFiles]:
    """The run of the first seed of each row that has one, by the positions of data set and row."""
    found: dict[Place, RunFiles] = {}
    for which, (name, entry) in enumerate(zip(data_set_names(report), report["data_sets"], strict=True)):
        beside = f", {name}" if name else ""
        for at, row in enumerate(entry["rows"]):
            runs = row.get("runs")
            where = value_at(runs[0], "folder") if isinstance(runs, list) and runs else None
            out = folder / where if isinstance(where, str) else None
            if out is not None and out.resolve().is_relative_to(folder.resolve()) and (out / "recipe.json").is_file():
                found[which, at] = read_source(out, f"{at + 1}. {row['label']}{beside}", len(found) + 1)
    return found


def table_section(report: Mapping[str, Any], runs: Mapping[Place, RunFiles]) -> Section:
    """A table of each data set with every quantity that a row has, then the published figures, then what each row
    changes."""
    rows = report["data_sets"][0]["rows"]
    elements: list[Element | None] = [Prose(_about(report))]
    for which, (name, entry) in enumerate(zip(data_set_names(report), report["data_sets"], strict=True)):
        own = {at: run for (there, at), run in runs.items() if there == which}
        elements.append(_table(entry["rows"], own, name))
    elements += [_published(rows), _changes(rows)]
    return Section("table", "Table", tuple(element for element in elements if element is not None))


def _table(rows: Sequence[Mapping[str, Any]], runs: Mapping[int, RunFiles], data_set: str) -> TableElement:
    """The rows on one data set."""
    names = _names(rows, "mean")
    cells, dimmed = [], tuple(at for at, row in enumerate(rows) if row.get("given_up"))
    for at, row in enumerate(rows):
        count = len(seeds) if isinstance(seeds := row.get("runs"), list) else 0
        link = runs[at].id("provenance") if at in runs else ""
        label = row["label"] if at not in dimmed else f"({row['label']})"
        failed = row.get("failed")
        note = f"failed: {failed}" if isinstance(failed, str) else ""
        if isinstance(file := row.get("file"), str) and not note:
            note = f"mesh of another program: {file}"
        if isinstance(other := row.get("not_as_named"), str):
            note = f"not run as named: {other}"
        first = (TableCell(f"{at + 1}. {label}", at, note, link), TableCell(str(count), count))
        cells.append((*first, *(_cell(row, name) for name in names)))
    head = ("row", "seeds", *(quantity(name).label for name in names))
    return TableElement(f"{data_set}: {CAPTION}" if data_set else CAPTION, head, tuple(cells), True, dimmed)


def _names(rows: Sequence[Mapping[str, Any]], key: str) -> list[str]:
    """Quantities that any row has: known ones in our order, then those of packages."""
    there = list(dict.fromkeys(name for row in rows for name in mapping(row, key)))
    return [name for name in QUANTITIES if name in there] + [name for name in there if name not in QUANTITIES]


def _about(report: Mapping[str, Any]) -> str:
    facts = [("Data", value_at(entry, "data", "path")) for entry in report["data_sets"]]
    facts += [("steps", report.get("steps")), ("seeds", report.get("seeds"))]
    facts += [("at most so many points", report.get("max_points"))]
    facts += [("truth", value_at(entry, "truth", "path")) for entry in report["data_sets"]]
    told = ", ".join(f"{name}: {in_words(value)}" for name, value in facts if value is not None)
    about = report.get("about")
    return f"{about}. {told}." if isinstance(about, str) else f"{told}."


def _cell(row: Mapping[str, Any], name: str) -> TableCell:
    """Mean and standard deviation, and below them the difference."""
    what, mean, deviation = quantity(name), number(row, "mean", name), number(row, "sd", name)
    if mean is None:
        return TableCell(NO_VALUE)
    text = what.shown(mean) + (f" ± {what.shown(deviation)}" if deviation is not None else "")
    change, base = number(row, "difference", name, "mean"), number(row, "difference", name, "base")
    if change is None or base is None:
        return TableCell(text, mean)
    return TableCell(
        text, mean, what.difference(base + change, base, number(row, "difference", name, "standard_error"))
    )


def _published(rows: Sequence[Mapping[str, Any]]) -> TableElement | None:
    """The figures of the paper, and the difference between its rows."""
    names = _names(rows, "paper")
    cells = []
    for at, row in enumerate(rows):
        values = [(name, number(row, "paper", name), number(row, "paper_difference", name)) for name in names]
        shown = [
            numeric(
                value,
                "" if value is None else quantity(name).shown(value),
                "" if value is None or change is None else quantity(name).difference(value, value - change),
            )
            for name, value, change in values
        ]
        cells.append((TableCell(f"{at + 1}. {row['label']}", at), *shown))
    head = ("row", *(quantity(name).label for name in names))
    return TableElement("Published figures of the rows", head, tuple(cells), True) if names else None


def _changes(rows: Sequence[Mapping[str, Any]]) -> TableElement:
    cells = []
    for at, row in enumerate(rows):
        own = ["a recipe of its own"] if row.get("own_recipe") is True else []
        own += [f"{path} = {in_words(value)}" for path, value in mapping(row, "change").items()]
        changes = "; ".join(own)
        base = row.get("built_on")
        cells.append(
            plain(f"{at + 1}. {row['label']}", base if isinstance(base, str) else NO_VALUE, changes or NO_VALUE)
        )
    return TableElement("What each row changes", ("row", "built on", "settings"), tuple(cells))
