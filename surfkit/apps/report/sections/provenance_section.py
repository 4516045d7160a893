"""Where each run comes from: versions, packages, machine, data."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone

from surfkit.apps.report.elements import ElementGroup, Section, TableCell, TableElement
from surfkit.apps.report.json_values import flat, in_words, mapping, plain, texts
from surfkit.apps.report.run_files import RunFiles, heading

RECORD_FIELDS = ("device", "threads", "seed")


def provenance(runs: Sequence[RunFiles]) -> Section:
    """A table for each run."""
    groups = [ElementGroup(heading(run, runs), (_table(run),), run.id("provenance")) for run in runs]
    return Section("provenance", "Provenance", tuple(groups))


def _table(run: RunFiles) -> TableElement:
    rows = [plain("folder", str(run.out.resolve()))]
    rows += [plain(f"version of {name}", in_words(value)) for name, value in mapping(run.record, "versions").items()]
    rows += [plain(name, in_words(run.record[name])) for name in RECORD_FIELDS if name in run.record]
    rows.append(plain("plugins", ", ".join(texts(run.record, "plugins")) or "none"))
    rows += [plain(path, in_words(value)) for path, value in flat(mapping(run.record, "data"), "data").items()]
    rows += [plain(path, in_words(value)) for path, value in flat(mapping(run.record, "frame"), "frame").items()]
    times = [line["time"] for part in run.parts for line in part.lines]
    if times:
        rows += [plain("first event", _moment(min(times))), plain("last event", _moment(max(times)))]
    return TableElement(
        f"Provenance of {run.name}", ("fact", "value"), tuple(row for row in rows if row[0] != TableCell("data"))
    )


def _moment(seconds: float) -> str:
    """Seconds since 1970 as date and time."""
    try:
        return datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (OverflowError, ValueError, OSError):
        return f"{seconds} s since 1970"
