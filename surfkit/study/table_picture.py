"""An ablation table as a picture: what each row brings, with its standard error, and what was published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surfkit.core.check import printable
from surfkit.core.files import remove, replacing
from surfkit.study.metric_columns import TABLE_COLUMNS
from surfkit.study.table_text import caption, columns_of, data_names, data_sets

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OF_QUALITY = ("psnr", "psnr_aligned", "f1", "precision", "recall", "ssim", "ssim_aligned", "lpips")
"""Columns that have a panel, the first ones first, as many as `MOST_PANELS`."""
MOST_PANELS = 3
PANEL_INCHES, ROW_INCHES, LABEL_LETTERS = 3.4, 0.3, 48
PICTURE_DPI = 110
KEPT, TRIED, PUBLISHED = "tab:blue", "0.65", "black"


def write_picture(path: Path, report: Mapping[str, Any]) -> bool:
    """Save bars of the differences to the row that each row is built on, as PNG.

    Args:
        path: Where.
        report: What ablation.json holds.

    Returns:
        Whether there was anything to draw: False, and no file, where no row could be compared yet.
    """
    entries = data_sets(report)
    rows = [row for row in entries[0]["rows"] if row["built_on"]]
    names = _panels(report)
    if not names:
        remove(path)  # of an earlier command with other rows or columns
        return False
    import matplotlib
    from matplotlib.figure import Figure  # without pyplot: no window system is asked for, and nothing is kept

    style = {**matplotlib.rcParamsDefault, "text.parse_math": False}  # labels may have dollar signs
    with matplotlib.rc_context({name: style[name] for name in style if name != "backend"}):
        size = (2.5 + PANEL_INCHES * len(names), 1.6 + ROW_INCHES * len(rows) * max(1, len(entries)))
        figure = Figure(size, PICTURE_DPI, layout="constrained")
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            _panel(axes, name, dict(zip(data_names(report), entries, strict=True)), rows)
        labels = [_shortened(f"{row['label']}  (on {_number(entries, row['built_on'])})") for row in rows]
        panels[0].set_yticks(range(len(rows)), labels)
        panels[0].set_ylim(len(rows) - 0.5, -0.5)
        figure.suptitle(printable(f"table:{report['table']}. {caption(report)}"), wrap=True, fontsize="medium")
        drawn, texts = panels[0].get_legend_handles_labels()
        found = dict(sorted(dict(zip(texts, drawn, strict=True)).items(), key=itemgetter(0)))
        figure.legend(found.values(), found.keys(), loc="outside lower center", ncols=2 * len(names), frameon=False)
        with replacing(path) as file:
            figure.savefig(file, format="png", metadata={"Software": None})
    return True


def _panels(report: Mapping[str, Any]) -> list[str]:
    """Columns in which a row could be compared."""
    shown = columns_of(report)
    found = {name for entry in data_sets(report) for row in entry["rows"] for name in row["difference"]}
    return [name for name in OF_QUALITY if name in found and name in shown][:MOST_PANELS]


def _panel(axes: Axes, name: str, entries: Mapping[str, Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> None:
    """The bars of one column: those of several data sets, by their names, side by side in each row."""
    column, height = TABLE_COLUMNS[name], 0.7 / len(entries)
    for at, (data, entry) in enumerate(entries.items()):
        by_label = {row["label"]: row for row in entry["rows"]}
        for place, row in enumerate(rows):
            step = by_label[row["label"]]["difference"].get(name)
            if step is None:
                continue
            y = place + (at - (len(entries) - 1) / 2) * height
            what = "measured, kept" if row["kept"] else "measured, not kept"
            told = what if len(entries) == 1 else f"{what}, {data}"
            color = KEPT if row["kept"] else TRIED
            axes.barh(y, step["mean"], height, color=color, alpha=1 - 0.5 * at / len(entries), label=printable(told))
            if step["standard_error"] is not None:
                spread = step["standard_error"]
                axes.errorbar(step["mean"], y, xerr=spread, color="black", capsize=3, label="standard error")
    published = [(row["paper_difference"][name], at) for at, row in enumerate(rows) if name in row["paper_difference"]]
    if published:
        steps, places = zip(*published, strict=True)
        axes.plot(steps, places, "D", color=PUBLISHED, fillstyle="none", label="published difference")
    axes.axvline(0, color="0.2", linewidth=1)
    axes.set_xlabel(f"difference in {column.head}" + (" (lower is better)" if column.better == "lower" else ""))
    axes.locator_params(axis="x", nbins=5)
    axes.grid(axis="x", color="0.88")
    axes.set_axisbelow(True)


def _number(entries: Sequence[Mapping[str, Any]], label: str) -> str:
    """The number in the table of the row with a label."""
    return next(str(row["number"]) for row in entries[0]["rows"] if row["label"] == label)


def _shortened(label: str) -> str:
    text = printable(label)
    return text if len(text) <= LABEL_LETTERS else f"{text[: LABEL_LETTERS - 1]}…"
