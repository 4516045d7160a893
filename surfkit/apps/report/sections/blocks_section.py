"""The plan of the blocks, and what became of each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from surfkit.apps.report.elements import (
    Element,
    ElementGroup,
    EmbeddedPicture,
    Figure,
    Section,
    TableCell,
    TableElement,
)
from surfkit.apps.report.json_values import NO_VALUE, number, numeric, value_at
from surfkit.apps.report.run_files import RunFiles, heading
from surfkit.apps.report.sections.notes_section import reduced
from surfkit.core.codec import read_json


def blocks(runs: Sequence[RunFiles], with_pictures: bool) -> Section | None:
    """The blocks of each run that has some."""
    groups = []
    for run in runs:
        if run.plan:
            elements: list[Element] = []
            picture = run.out / "blocks" / "plan.png"
            if with_pictures and picture.is_file():
                caption = "from above: points in the colour of their block, cameras as rings"
                elements.append(Figure(EmbeddedPicture(picture, f"blocks of {run.name} from above"), caption))
            groups.append(ElementGroup(heading(run, runs), (*elements, _table(run)), run.id("blocks")))
    return Section("blocks", "Blocks", tuple(groups)) if groups else None


def _table(run: RunFiles) -> TableElement:
    planned, merged = value_at(run.plan, "plan", "blocks"), _merged(run)
    rows = []
    for at, block in enumerate(planned if isinstance(planned, list) else ()):
        views = value_at(block, "views")
        state = _json(run, f"{at:03}/state.json")
        trouble = "; ".join(text for text in (_text(state, "error"), reduced(state)) if text)
        counts = (len(views) if isinstance(views, list) else None, number(state, "step"), number(state, "attempts"))
        kept = number(merged.get(at), "kept")
        cells = [numeric(value, "" if value is None else f"{value:,.0f}") for value in (*counts, kept)]
        rows.append(
            (
                TableCell(str(at), at),
                TableCell(_text(state, "status") or NO_VALUE),
                *cells,
                TableCell(trouble or NO_VALUE),
            )
        )
    head = ("block", "state", "views", "steps", "attempts", "points after merging", "errors and fallbacks")
    return TableElement("Blocks", head, tuple(rows), is_sortable=True)


def _merged(run: RunFiles) -> dict[int, Any]:
    """What the merge says of each block, by its number."""
    found = _json(run, "merge.json").get("blocks")
    return {at: one for one in found if (at := value_at(one, "index")) is not None} if isinstance(found, list) else {}


def _json(run: RunFiles, name: str) -> dict[str, Any]:
    path = run.out / "blocks" / name
    return read_json(path, dict[str, Any]) if path.exists() else {}


def _text(data: dict[str, Any], key: str) -> str:
    found = data.get(key)
    return found if isinstance(found, str) else ""
