"""What was left out, replaced, lowered or tried again in each run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from surfkit.apps.report.elements import ElementGroup, Listing, Prose, Section
from surfkit.apps.report.json_values import number, texts, value_at
from surfkit.apps.report.run_files import JournaledStage, RunFiles, heading

MISSING = {
    "not_measured": "photographs are not measured",
    "lpips_not_measured": "LPIPS is not measured",
}
"""Reasons that metrics.json gives."""


def notes(runs: Sequence[RunFiles]) -> Section:
    """Every note once: a list for each set of runs that share some, the largest set first."""
    noting: dict[str, list[RunFiles]] = {}
    for run in runs:
        for text in texts_of(run):
            noting.setdefault(text, []).append(run)
    lists: dict[str, list[str]] = {}
    for text, some in sorted(noting.items(), key=lambda item: -len(item[1])):
        lists.setdefault(_title(some, runs), []).append(text)
    groups = tuple(ElementGroup(title, (Listing(tuple(found)),)) for title, found in lists.items())
    nothing = Prose("Nothing was left out, replaced or lowered.")
    return Section("notes", "Notes and automatic changes", groups or (nothing,))


def _title(some: Sequence[RunFiles], runs: Sequence[RunFiles]) -> str:
    """Which of the runs they are, in few words; "" where there is only one run."""
    others = [run for run in runs if run not in some]
    if others and len(others) < len(some):
        return f"All runs but {'; '.join(run.name for run in others)}"
    return "; ".join(heading(run, runs) for run in some) if others or len(runs) == 1 else "All runs"


def texts_of(run: RunFiles) -> list[str]:
    """Everything that a run notes about itself, each text once."""
    found = [] if run.metrics else ["The run is not finished: there is no metrics.json."]
    found += texts(run.record, "notes")
    reasons = {line.get("name"): line.get("reason") for part in run.parts for line in part.of("PhotoSkipped")}
    for name in texts(run.record, "skipped"):
        reason = reasons.get(name)
        found.append(f"photograph {name} was skipped" + (f": {reason}" if isinstance(reason, str) else ""))
    for part in run.parts:
        found += [line["text"] for line in part.of("Warned") if isinstance(line.get("text"), str)]
        found += _resumed(part)
    for key, words in MISSING.items():
        if isinstance(reason := value_at(run.metrics, "images", key), str):
            found.append(f"{words}: {reason}")
    known = list(dict.fromkeys(found))
    return [text for text in known if not any(other != text and other.endswith(f": {text}") for other in known)]


def _resumed(part: JournaledStage) -> list[str]:
    """A text for each time that steps went on after an interruption."""
    firsts = [number(line, "first") for line in part.of("StageBegan")]
    return [f"{part.title} continued after step {first - 1:,.0f}" for first in firsts if first and first > 1]


def reduced(state: Any) -> str:
    """What a block had to do with less of, as its state.json says."""
    return ", ".join(texts(state, "reduced") or texts(state, "eased"))
