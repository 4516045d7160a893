"""The figures of each run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from surfkit.apps.report.elements import Prose, Section, TableCell, TableElement
from surfkit.apps.report.json_values import QUANTITIES, in_words, mapping, number, numeric, of_metrics, plain, value_at
from surfkit.apps.report.run_files import RunFiles

DEPTH_DATA = ("priors", "depth_layout", "depth_of")
"""Settings of the data set that say nothing of its photographs."""
COMPARED_BY = {
    "truth": ("truth",),
    "tau": ("tau",),
    "alignment": ("align",),
    "preset": ("preset",),
    "crop volume": ("crop", "from"),
    "area": ("area", "file"),
}
"""What decides precision, recall and F1, and where metrics.json has it under "geometry"."""
SEAM_PARTS = {"near": "near block borders", "elsewhere": "away from block borders"}


def results(runs: Sequence[RunFiles]) -> Section:
    """All figures of one run, or the runs as rows with their differences to the first one."""
    measured = [figures(run) for run in runs]
    names = [name for name in QUANTITIES if any(name in one for one in measured)]
    if len(runs) == 1:
        rows = [plain(QUANTITIES[name].label, QUANTITIES[name].shown(measured[0][name])) for name in names]
        table = TableElement("Figures of the run", ("quantity", "value"), (*rows, *_parts(runs[0])))
        return Section("results", "Results", (table,))
    rows = [
        (TableCell(run.name, at, link=run.id("provenance")), *(_cell(one, name, measured[0], at) for name in names))
        for at, (run, one) in enumerate(zip(runs, measured, strict=True))
    ]
    caption = f"Figures of the runs, with the differences to {runs[0].name}"
    head = ("run", *(QUANTITIES[name].label for name in names))
    table = TableElement(caption, head, tuple(rows), is_sortable=True)
    return Section("results", "Results", (*_of_other_data(runs), *_compared_otherwise(runs), table))


def _of_other_data(runs: Sequence[RunFiles]) -> tuple[Prose, ...]:
    """A warning where runs were not trained and measured on the same photographs, of the same size."""
    data = [{name: it for name, it in mapping(run.record, "data").items() if name not in DEPTH_DATA} for run in runs]
    names = [name for name in dict.fromkeys(name for one in data for name in one) if len(_values(data, name)) > 1]
    if not names:
        return ()
    which = ", ".join(f"data.{name}" for name in names)
    return (Prose(f"The runs have other photographs, or read them otherwise: {which}. Their figures may not compare."),)


def _compared_otherwise(runs: Sequence[RunFiles]) -> tuple[Prose, ...]:
    """A warning where surfaces were not compared with the same truth in the same way."""
    found = [geometry for run in runs if (geometry := mapping(run.metrics, "geometry"))]
    ways = [{name: value_at(one, *path) or "none" for name, path in COMPARED_BY.items()} for one in found]
    names = [name for name in COMPARED_BY if len(_values(ways, name)) > 1]
    if not names:
        return ()
    told = "; ".join(f"{name}: {', '.join(sorted(_values(ways, name)))}" for name in names)
    return (Prose(f"The surfaces were compared with the truth in several ways: {told}. Their figures do not compare."),)


def _values(data: Sequence[dict[str, Any]], name: str) -> set[str]:
    return {in_words(one.get(name)) for one in data}


def figures(run: RunFiles) -> dict[str, float]:
    """What was measured of a run, by the names in `QUANTITIES`; the size is that of its point_cloud.ply."""
    found = {name: of_metrics(run.metrics, name) for name in QUANTITIES if name != "bytes"}
    cloud = run.out / "point_cloud.ply"
    found["bytes"] = float(cloud.stat().st_size) if cloud.is_file() else None
    return {name: value for name, value in found.items() if value is not None}


def _cell(one: dict[str, float], name: str, first: dict[str, float], at: int) -> TableCell:
    value, what = one.get(name), QUANTITIES[name]
    if value is None:
        return numeric(None, "")
    return numeric(value, what.shown(value), what.difference(value, first[name]) if at > 0 and name in first else "")


def _parts(run: RunFiles) -> list[tuple[TableCell, ...]]:
    """PSNR of parts of the photographs that `surfkit evaluate --seen --seams` has measured."""
    found = []
    by_views = value_at(run.metrics, "images", "seen", "by_views")
    for least in by_views if isinstance(by_views, dict) else ():
        if (psnr := number(by_views, least, "psnr")) is not None:
            found.append(plain(f"PSNR where {least} or more training views see the surface, dB", f"{psnr:.2f}"))
    for part, words in SEAM_PARTS.items():
        if (psnr := number(run.metrics, "images", "seams", part, "psnr")) is not None:
            found.append(plain(f"PSNR {words}, dB", f"{psnr:.2f}"))
    return found
