"""An ablation table for people: as text, as Markdown, and on a terminal.

All of them show `report`, the plain data that ablation.json holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.table import Table
from rich.text import Text

METRICS = {"psnr": 2, "ssim": 3, "points": None, "f1": 3}
"""Digits of the numbers that are shown with their difference, which for points is in percent."""

LEGEND = (
    "Numbers are means over the seeds ± standard deviation. Differences are to the row that a row is built on, the "
    "last one above that is not in brackets; ± is the standard error of the differences between runs of one seed. "
    "CPU minutes are of all processors, with the depth maps that were made for the run, and without its mesh."
)
STACKED = "Below each number are the difference and, dimmed, what was published with its difference."


def lines(report: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of texts, with the published figures in columns of their own where there are any."""
    names = ("PSNR", "diff.", "SSIM", "diff.", "points", "diff.", "F1", "diff.")
    head = ["", "row", "seeds", *names, "minutes", "CPU min", *(f"paper: {name}" for name in names)]
    return head, [[*_own(report, row), *_published(report, row)] for row in report["rows"]]


def failures(report: Mapping[str, Any]) -> list[str]:
    """A line for each row that could not be run."""
    return [f"{row['label']}: failed: {row['failed']}" for row in report["rows"] if row["failed"]]


def markdown(report: Mapping[str, Any]) -> str:
    """The table as a Markdown page."""
    head, rows = lines(report)
    marks = ["---:" if at != 1 else "---" for at in range(len(head))]
    table = ["| " + " | ".join(text.replace("|", "\\|") for text in row) + " |" for row in [head, marks, *rows]]
    data = report["data"]["path"].rpartition("/")[2]
    limit = f"; at most {report['max_points']:,} points" if report["max_points"] else ""
    what = f"{report['about']}. Data: {data}; steps: {report['steps']:,}; seeds: {report['seeds']}{limit}."
    broken = [f"- {text}" for text in failures(report)]
    parts = [f"# table:{report['table']}", what, "\n".join(table), LEGEND, "\n".join(broken)]
    return "\n\n".join(part for part in parts if part) + "\n"


def drawing(report: Mapping[str, Any], running: str | None = None) -> Table:
    """The table for a terminal; each number has its difference and the published figure below it.

    Args:
        report: What is known so far.
        running: Label of the row at work.
    """
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for head in ("", "row", "seeds", "PSNR", "SSIM", "points", "F1", "min", "CPU min"):
        table.add_column(head, justify="left" if head == "row" else "right", no_wrap=head != "row")
    for row in report["rows"]:
        number, label, seeds, *own, minutes, cpu = _own(report, row)
        paper = _published(report, row)
        style = "red" if row["failed"] else "bold" if row["label"] == running else "" if row["kept"] else "italic"
        cells = [_stacked(*own[i : i + 2], *paper[i : i + 2], style) for i in (0, 2, 4, 6)]
        table.add_row(number, Text(label, style), seeds, *cells, minutes, cpu)
    return table


def _stacked(value: str, step: str, paper: str, paper_step: str, style: str) -> Text:
    text = Text("\n".join(filter(None, [value or "-", step])), style)
    return text.append("\n" + " ".join(filter(None, [paper, paper_step])), "dim") if paper else text


def _own(report: Mapping[str, Any], row: Mapping[str, Any]) -> list[str]:
    """Number, label, seeds, then value and difference of PSNR, SSIM, points and F1, then minutes and those of CPUs."""
    label = row["label"] if row["kept"] else f"({row['label']})"
    cells = [str(row["number"]), label, "failed" if row["failed"] else f"{len(row['runs'])}/{report['seeds']}"]
    mean, sd, step = row["mean"], row["sd"], row["difference"]
    if not mean:
        return [*cells, *[""] * 10]
    for name, digits in METRICS.items():
        if name not in mean:
            cells += ["", ""]
        elif digits is None:
            cells.append(f"{mean[name]:,.0f}" + (f" ± {sd[name]:,.0f}" if sd[name] is not None else ""))
            cells.append(_difference(step[name], 100 / step[name]["base"], 1, " %") if name in step else "")
        else:
            cells.append(_spread(f"{mean[name]:.{digits}f}", sd[name], digits))
            cells.append(_difference(step[name], 1, digits) if name in step else "")
    return [*cells, f"{mean['seconds'] / 60:.1f}", f"{mean['cpu_seconds'] / 60:.1f}"]


def _published(report: Mapping[str, Any], row: Mapping[str, Any]) -> list[str]:
    """Value and difference in print of PSNR, SSIM, points and F1."""
    paper, step = row["paper"], row["paper_difference"]
    cells = []
    for name, digits in METRICS.items():
        if digits is None:
            cells.append(f"{paper[name] / 1e6:.2f} M" if name in paper else "")
            cells.append(f"{100 * step[name] / (paper[name] - step[name]):+.1f} %" if name in step else "")
        else:
            cells.append(f"{paper[name]:.{digits}f}" if name in paper else "")
            cells.append(f"{step[name]:+.{digits}f}" if name in step else "")
    return cells


def _difference(step: Mapping[str, Any], factor: float, digits: int, unit: str = "") -> str:
    error = step["standard_error"]
    text = f"{step['mean'] * factor:+.{digits}f}"
    return _spread(text, None if error is None else error * factor, digits) + unit


def _spread(text: str, spread: float | None, digits: int) -> str:
    return text if spread is None else f"{text} ± {spread:.{digits}f}"
