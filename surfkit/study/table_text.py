"""An ablation table for people: as text, as Markdown, and on a terminal.

All of them show `report`, the plain data that ablation.json holds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table
from rich.text import Text

from surfkit.core.check import printable
from surfkit.study.ablation_warnings import row_numbers
from surfkit.study.metric_columns import TABLE_COLUMNS, shown_columns
from surfkit.study.shared_stages import sharing_lines

CPU_LEGEND = "CPU minutes are of all processors, with the depth maps that were made for the run, and without its mesh."
LEGEND = (
    "Numbers are means over the seeds ± standard deviation, with the difference to the row whose number is in column "
    "'on'; ± of a difference is the standard error over pairs of runs with the same seed. Rows in brackets were tried "
    f"and not kept. {CPU_LEGEND} Where the recipe compresses the model, quality, size and FPS are those of the "
    "compressed model."
)
STACKED = "Below each number are the difference and, dimmed, what was published with its difference."


@dataclass(frozen=True)
class FormattedNumber:
    """A number of a table in words.

    Attributes:
        value: The number, with its spread; "" if there is none.
        difference: To the row that it is compared with; "" if there is none.
        best: Whether no row of the same part of the table has a better one, of those that were kept.
    """

    value: str = ""
    difference: str = ""
    best: bool = False

    def __str__(self) -> str:
        return f"{self.value} ({self.difference})" if self.difference else self.value


def data_sets(report: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What is known of each data set: "data", "rows" and "truth"."""
    return list(report["data_sets"])


def data_names(report: Mapping[str, Any]) -> list[str]:
    """The names of the data sets: of their folders, see `distinct_names`."""
    return distinct_names([entry["data"]["path"] for entry in data_sets(report)])


def distinct_names(paths: Sequence[str]) -> list[str]:
    """The last part of each path, with as many parts before it as tell all of them apart: folders of photogrammetry
    are often called alike, as site1/dense and site2/dense are."""
    parts = [path.split("/") for path in paths]
    lengths = range(1, max(map(len, parts), default=1) + 1)
    tails = (["/".join(each[-length:]) for each in parts] for length in lengths)
    return next((names for names in tails if len(set(names)) == len(names)), [each[-1] for each in parts])


def columns_of(report: Mapping[str, Any]) -> list[str]:
    """Names of the columns to show: those that the user asked for, or that were measured and are shown by default or
    by this table, or else published."""
    rows = [row for entry in data_sets(report) for row in entry["rows"]]
    measured = {name for row in rows for name in row["mean"]} or {name for row in rows for name in row["paper"]}
    return shown_columns(report.get("columns") or (), measured, report.get("also") or ())


def published_columns(report: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Those of some columns that a row has a published figure of."""
    return [name for name in names if any(name in row["paper"] for row in data_sets(report)[0]["rows"])]


def measured_cells(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[list[FormattedNumber]]:
    """The measured numbers of all rows of one data set, row by row."""
    best = [best_rows(rows, name) for name in names]
    return [[_measured(row, name, at in best[i]) for i, name in enumerate(names)] for at, row in enumerate(rows)]


def published_cells(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[list[FormattedNumber]]:
    """The published numbers of all rows, row by row."""
    return [[_published(row, name) for name in names] for row in rows]


def parts(rows: Sequence[Mapping[str, Any]]) -> list[list[int]]:
    """Positions of the rows of each part of a table."""
    found: list[list[int]] = []
    for at, row in enumerate(rows):
        if row["group"] or not found:
            found.append([])
        found[-1].append(at)
    return found


def best_rows(rows: Sequence[Mapping[str, Any]], name: str) -> set[int]:
    """Positions of the rows with the best number of a column in their part; none where all are as good.

    Numbers that are written alike are equally good. Rows that were given up do not count.
    """
    column, found = TABLE_COLUMNS[name], set()
    for part in parts(rows):
        values = {at: rows[at]["mean"][name] for at in part if name in rows[at]["mean"] and not rows[at]["given_up"]}
        texts = {at: column.text(value) for at, value in values.items()}
        if len(set(texts.values())) > 1:
            best = column.text((max if column.better == "higher" else min)(values.values()))
            found |= {at for at, text in texts.items() if text == best}
    return found


def _measured(row: Mapping[str, Any], name: str, best: bool) -> FormattedNumber:
    column, step = TABLE_COLUMNS[name], row["difference"].get(name)
    if name not in row["mean"]:
        return FormattedNumber()
    change = "" if step is None else column.difference(step["mean"], step["base"], step["standard_error"])
    return FormattedNumber(column.text(row["mean"][name], row["sd"][name]), change, best)


def _published(row: Mapping[str, Any], name: str) -> FormattedNumber:
    column, paper, step = TABLE_COLUMNS[name], row["paper"], row["paper_difference"].get(name)
    if name not in paper:
        return FormattedNumber()
    return FormattedNumber(
        column.text(paper[name]), "" if step is None else column.difference(step, paper[name] - step)
    )


def lines(report: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of texts: of every data set, then the published figures, in columns of their own."""
    entries, names = data_sets(report), columns_of(report)
    paper, first = published_columns(report, names), data_sets(report)[0]["rows"]
    groups = [measured_cells(entry["rows"], names) for entry in entries] + [published_cells(first, paper)]
    head = ["", "row", "on", "seeds"]
    for data in data_names(report):
        head += [TABLE_COLUMNS[name].head + (f" {data}" if len(entries) > 1 else "") for name in names]
    head += [f"paper: {TABLE_COLUMNS[name].head}" for name in paper]
    body = [
        [*names_of_row(report, at), *(str(cell) for group in groups for cell in group[at])] for at in indices(first)
    ]
    return head, body


def indices(rows: Sequence[Mapping[str, Any]]) -> range:
    """Positions of the rows."""
    return range(len(rows))


def names_of_row(report: Mapping[str, Any], at: int) -> list[str]:
    """Number, label, number of the row that it builds on, and how many of its runs are there, in each data set."""
    entries = data_sets(report)
    rows, seeds = entries[0]["rows"], report["seeds"]
    row = rows[at]
    numbers = {other["label"]: str(other["number"]) for other in rows}
    states = ["failed" if e["rows"][at]["failed"] else f"{len(e['rows'][at]['runs'])}/{seeds}" for e in entries]
    states = ["file" if row.get("file") and s != "failed" else s for s in states]
    states = ["blank" if e["rows"][at].get("not_as_named") else s for e, s in zip(entries, states, strict=True)]
    label = f"({row['label']})" if row["given_up"] else row["label"]
    return [str(row["number"]), label, numbers.get(row["built_on"], ""), ", ".join(states)]


def failures(report: Mapping[str, Any]) -> list[str]:
    """A line for each row that could not be run."""
    entries = data_sets(report)
    many = len(entries) > 1
    return [
        f"{row['label']}{f', {data}' if many else ''}: failed: {row['failed']}"
        for data, entry in zip(data_names(report), entries, strict=True)
        for row in entry["rows"]
        if row["failed"]
    ]


def blanks(report: Mapping[str, Any]) -> list[str]:
    """A line for each reason why rows that were run have no figures, with these rows."""
    found: dict[str, list[str]] = {}
    for entry in data_sets(report):
        for row in entry["rows"]:
            if row.get("not_as_named") and row["label"] not in found.setdefault(row["not_as_named"], []):
                found[row["not_as_named"]].append(row["label"])
    return [f"not run as named, and blank: {', '.join(labels)}: {reason}" for reason, labels in found.items()]


def note_lines(report: Mapping[str, Any]) -> list[str]:
    """A line for each note of the runs, with the rows that it is about."""
    entries = data_sets(report)
    labels = [row["label"] for row in entries[0]["rows"]]
    return [
        f"{row_numbers(note['rows'], labels)}{f', {data}' if len(entries) > 1 else ''}: {note['text']}"
        for data, entry in zip(data_names(report), entries, strict=True)
        for note in entry["notes"]
    ]


def caption(report: Mapping[str, Any]) -> str:
    """What the table shows, and what of."""
    limit = f"; at most {report['max_points']:,} points, or as many in each block" if report["max_points"] else ""
    data = ", ".join(data_names(report))
    about = report["about"].rstrip(".")
    return f"{about}{about and '. '}Data: {data}; steps: {report['steps']:,}; seeds: {report['seeds']}{limit}."


def markdown(report: Mapping[str, Any]) -> str:
    """The table as a Markdown page; the best numbers of each part are bold, and its heading is a row."""
    head, rows = lines(report)
    entries, names = data_sets(report), columns_of(report)
    for at, cells in enumerate(zip(*(measured_cells(entry["rows"], names) for entry in entries), strict=True)):
        for place, cell in enumerate((cell for group in cells for cell in group), 4):
            if cell.best:
                rows[at][place] = str(FormattedNumber(f"**{cell.value}**", cell.difference))
    marks = ["---" if at == 1 else "---:" for at in range(len(head))]
    body = [head, marks]
    for row, data in zip(rows, entries[0]["rows"], strict=True):
        body += [["", f"*{data['group']}*", *[""] * (len(head) - 2)]] * bool(data["group"]) + [row]
    table = ["| " + " | ".join(text.replace("|", "\\|") for text in row) + " |" for row in body]
    told = [f"- {text}" for text in (*failures(report), *blanks(report), *note_lines(report), *sharing_lines(report))]
    legend = f"{LEGEND} Bold is the best number of its part of the table."
    page = [f"# table:{report['table']}", caption(report), "\n".join(table), legend, "\n".join(told)]
    return "\n\n".join(part for part in page if part) + "\n"


def drawing(report: Mapping[str, Any], running: str | None = None) -> Table:
    """The table for a terminal; each number has its difference below it.

    Published figures are dimmed: below the numbers of a single data set, in columns of their own beside several.

    Args:
        report: What is known so far.
        running: Label of the row at work.
    """
    entries, names = data_sets(report), columns_of(report)
    rows, paper = entries[0]["rows"], published_columns(report, names)
    own = [measured_cells(entry["rows"], names) for entry in entries]
    beside = paper if len(entries) > 1 else []
    below = published_cells(rows, names if len(entries) == 1 else beside)
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for head in (
        "",
        "row",
        "on",
        "seeds",
        *_heads(data_names(report), names),
        *(f"{TABLE_COLUMNS[n].head}\npaper" for n in beside),
    ):
        table.add_column(
            Text(printable(head, lines=True)), justify="left" if head == "row" else "right", no_wrap=head != "row"
        )
    for at, row in enumerate(rows):
        failed = any(entry["rows"][at]["failed"] for entry in entries)
        style = "red" if failed else "bold" if row["label"] == running else "dim" if row["given_up"] else ""
        if row["group"]:
            table.add_row("", Text(printable(row["group"]), "italic"))
        number, label, on, seeds = names_of_row(report, at)
        label = f"> {label}" if row["label"] == running else label
        stacked = below[at] if len(entries) == 1 else [FormattedNumber()] * len(names)
        cells = [_stacked(*pair, style) for group in own for pair in zip(group[at], stacked, strict=True)]
        extra = [Text(_two_lines(cell), "dim") for cell in (below[at] if beside else ())]
        table.add_row(number, Text(printable(label), style), on, seeds, *cells, *extra)
    return table


def _heads(data: Sequence[str], names: Sequence[str]) -> Iterable[str]:
    for each in data:
        yield from (TABLE_COLUMNS[name].head + (f"\n{each}" if len(data) > 1 else "") for name in names)


def _stacked(cell: FormattedNumber, paper: FormattedNumber, style: str) -> Text:
    text = Text(_two_lines(cell) or "-", style)
    return text.append(f"\n{' '.join(filter(None, [paper.value, paper.difference]))}", "dim") if paper.value else text


def _two_lines(cell: FormattedNumber) -> str:
    return "\n".join(filter(None, [cell.value, cell.difference]))
