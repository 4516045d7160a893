"""What a run has written, as far as it has come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.report.json_values import number, value_at
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.runs import journal
from surfkit.runs.folder import refuse_no_run
from surfkit.study.run_curves import thinned

JSON_FILES = {
    "recipe": "recipe.json",
    "record": "run.json",
    "metrics": "metrics.json",
    "mesh": "mesh.json",
    "compressed": "compressed/compressed.json",
    "plan": "blocks/plan.json",
}
"""JSON files of a run folder, by the attributes of `RunFiles`."""


@dataclass(frozen=True)
class JournaledStage:
    """A part of a run whose steps are counted on their own: the first stage, a block, a refinement.

    Attributes:
        title: What it is.
        folder: Where its journal lies.
        lines: Of the journal.
    """

    title: str
    folder: Path
    lines: list[dict[str, Any]]

    def of(self, event: str) -> list[dict[str, Any]]:
        """The lines of one kind of event."""
        return [line for line in self.lines if line["event"] == event]

    def series(self, value: Callable[[dict[str, Any]], float | None], event: str = "StepDone") -> np.ndarray | None:
        """(2, T) steps and values of those lines that have one; None where there are no two of them."""
        found = [(number(line, "index"), value(line)) for line in self.of(event)]
        rows = np.array([pair for pair in found if None not in pair], dtype=np.float64)
        return np.stack(thinned(rows)) if len(rows) > 1 else None


@dataclass(frozen=True)
class RunFiles:
    """A run folder.

    Attributes:
        name: How the report calls it.
        number: Of the run in the report, from 1; part of addresses within the page.
        out: The folder.
        recipe: recipe.json.
        record: run.json.
        metrics: metrics.json; these and the following ones are empty where there is no such file.
        mesh: mesh.json.
        compressed: compressed/compressed.json.
        plan: blocks/plan.json.
    """

    name: str
    number: int
    out: Path
    recipe: dict[str, Any]
    record: dict[str, Any]
    metrics: dict[str, Any]
    mesh: dict[str, Any]
    compressed: dict[str, Any]
    plan: dict[str, Any]

    @cached_property
    def parts(self) -> tuple[JournaledStage, ...]:
        """The first stage, then blocks, then refinements, as far as they are begun."""
        first = "first stage" if self.plan or (self.out / "refine0").is_dir() else "training"
        found = [(first, self.out)]
        for title, pattern, before in (("block", "blocks/[0-9]*", ""), ("refinement", "refine[0-9]*", "refine")):
            named = [(path.name.removeprefix(before), path) for path in self.out.glob(pattern)]
            numbered = sorted((int(name), path) for name, path in named if name.isdecimal())
            found += [(f"{title} {index}", path) for index, path in numbered]
        parts = [JournaledStage(title, folder, journal.read(folder / journal.JOURNAL_FILE)) for title, folder in found]
        return tuple(part for part in parts if part.lines)

    @property
    def first(self) -> JournaledStage:
        """The first stage, perhaps without a line."""
        return next((part for part in self.parts if part.folder == self.out), JournaledStage("training", self.out, []))

    @property
    def blocks(self) -> tuple[JournaledStage, ...]:
        """The blocks that are begun."""
        return tuple(part for part in self.parts if part.title.startswith("block "))

    @cached_property
    def photo_sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height of the photographs, by name, from cameras.json."""
        path = self.out / "cameras.json"
        found = {}
        for camera in read_json(path, tuple[Any, ...]) if path.exists() else ():
            name, width, height = value_at(camera, "img_name"), number(camera, "width"), number(camera, "height")
            if width and height and isinstance(name, str):
                found[name] = (int(width), int(height))
        return found

    def id(self, section: str) -> str:
        """Address of what a section says of the run."""
        return f"{section}-{self.number}"


def read_source(out: Path, name: str, at: int) -> RunFiles:
    """What lies in a run folder.

    Raises:
        BadInput: It is none, or one of its files is damaged.
    """
    refuse_no_run(out)
    found = {key: out / file for key, file in JSON_FILES.items()}
    return RunFiles(name, at, out, **{k: read_json(p, dict[str, Any]) if p.exists() else {} for k, p in found.items()})


def read_sources(outs: Sequence[Path]) -> tuple[RunFiles, ...]:
    """The runs in some folders, each with a name that no other one has.

    Raises:
        BadInput: One is no run folder, or named twice.
    """
    resolved = [out.resolve() for out in outs]
    if twice := [out for at, out in enumerate(outs) if resolved[at] in resolved[:at]]:
        raise BadInput(f"report: {twice[0]} is named twice; name each run once")
    short = [out.name for out in resolved]
    names = [name if short.count(name) == 1 else str(out) for name, out in zip(short, resolved, strict=True)]
    return tuple(read_source(out, name, at) for at, (out, name) in enumerate(zip(outs, names, strict=True), 1))


def total_loss(line: dict[str, Any]) -> float | None:
    """The sum of the weighted losses of a step."""
    losses = line.get("losses")
    values = [number(losses, name) for name in losses] if isinstance(losses, dict) else []
    known = [value for value in values if value is not None]
    return sum(known) if known and len(known) == len(values) else None


def heading(run: RunFiles, runs: Sequence[RunFiles]) -> str:
    """What stands above a part of a section that is about one run: nothing where there is only one."""
    return run.name if len(runs) > 1 else ""
