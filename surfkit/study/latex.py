"""An ablation table for a paper: LaTeX with the rules of booktabs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from surfkit.study.metric_columns import TABLE_COLUMNS
from surfkit.study.table_text import (
    CPU_LEGEND,
    FormattedNumber,
    blanks,
    caption,
    columns_of,
    data_names,
    data_sets,
    measured_cells,
    published_columns,
)
from surfkit.study.table_text import published_cells as published

PREAMBLE_NOTE = r"% In the preamble: \usepackage{adjustbox,booktabs} and \usepackage[table]{xcolor}"
GREEK = """
alpha beta gamma delta varepsilon eta theta kappa lambda mu pi rho sigma tau varphi omega Delta Sigma Omega
"""
SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "±": r"$\pm$",
    "×": r"$\times$",
    "−": r"$-$",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "→": r"$\rightarrow$",
    "[": "{[}",  # after the end of a row, this and the next would belong to its \\
    "*": "{*}",
} | {letter: f"\\{letter}" for letter in "&%$#_{}"}
"""What LaTeX does not take as it stands, and what it takes instead."""
SPECIAL |= {letter: rf"$\{name}$" for letter, name in zip("αβγδεηθκλμπρστφωΔΣΩ", GREEK.split(), strict=True)}
DAGGER = r"$^\dagger$"
"""Mark of rows that could not run as they are named."""
ARROWS = {"higher": r"$\uparrow$", "lower": r"$\downarrow$"}


def escape(text: str) -> str:
    """A text as LaTeX prints it."""
    return re.sub("|".join(map(re.escape, SPECIAL)), lambda found: SPECIAL[found[0]], text)


def latex(report: Mapping[str, Any]) -> str:
    """The table as a LaTeX `table`: the best numbers of each part are bold, rows that were given up are grey.

    Without differences and numbers of rows; the published figures are the last columns.
    """
    entries, names = data_sets(report), columns_of(report)
    rows, paper = entries[0]["rows"], published_columns(report, names)
    named = zip(data_names(report), entries, strict=True)
    groups = [(data, names, measured_cells(entry["rows"], names)) for data, entry in named]
    groups += [("published", paper, published(rows, paper))] if paper else []
    width = 1 + sum(len(columns) for _, columns, _ in groups)
    body = []
    for at, row in enumerate(rows):
        if row["group"]:
            body += [r"\midrule"] * bool(at) + [
                rf"\multicolumn{{{width}}}{{l}}{{\textit{{{escape(row['group'])}}}}} \\"
            ]
        cells = [_cell(cell) for _, _, group in groups for cell in group[at]]
        grey = r"\rowcolor{gray!20} " if row["given_up"] else ""
        mark = DAGGER if any(entry["rows"][at].get("not_as_named") for entry in entries) else ""
        body.append(grey + " & ".join([escape(row["label"]) + mark, *cells]) + r" \\")
    return "\n".join(
        [
            PREAMBLE_NOTE,
            r"\begin{table}[t]",
            r"\centering",
            rf"\caption{{{escape(caption(report))}}}",
            rf"\label{{tab:{re.sub(r'[^A-Za-z0-9_-]+', '-', report['table'])}}}",
            r"\begin{adjustbox}{max width=\textwidth}",
            rf"\begin{{tabular}}{{l{'r' * (width - 1)}}}",
            r"\toprule",
            *_heads([(title, columns) for title, columns, _ in groups]),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{adjustbox}",
            rf"\par\smallskip {{\footnotesize {escape(legend(report, names))}}}",
            *(rf"\par\smallskip {{\footnotesize {DAGGER} {escape(text)}.}}" for text in blanks(report)),
            r"\end{table}",
            "",
        ]
    )


def legend(report: Mapping[str, Any], names: Sequence[str]) -> str:
    """How the table is read, as far as it needs to be said: bold and grey, deviations, CPU minutes."""
    rows = [row for entry in data_sets(report) for row in entry["rows"]]
    told = ["Bold is the best number of its part of the table."]
    if any(row["given_up"] for row in rows):
        told += ["Grey rows were tried and not kept."]
    if any(spread is not None for row in rows for spread in row["sd"].values()):
        told += ["Numbers are means over the seeds ± standard deviation."]
    if "cpu_seconds" in names:
        told += [CPU_LEGEND]
    return " ".join(told)


def _heads(groups: Sequence[tuple[str, Sequence[str]]]) -> list[str]:
    """The lines above the rows: titles of the groups of columns, where there are several, and of the columns."""
    titles, rules, at = [], [], 2
    for title, columns in groups:
        titles.append(rf"\multicolumn{{{len(columns)}}}{{c}}{{{escape(title)}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + len(columns) - 1}}}")
        at += len(columns)
    heads = [
        escape(TABLE_COLUMNS[name].head) + ARROWS[TABLE_COLUMNS[name].better]
        for _, columns in groups
        for name in columns
    ]
    upper = [" & ".join(["", *titles]) + r" \\", " ".join(rules)] if len(groups) > 1 else []
    return [*upper, " & ".join(["", *heads]) + r" \\"]


def _cell(cell: FormattedNumber) -> str:
    text = re.sub(r" (\w?B|[MG])$", r"\\,\1", escape(cell.value))
    return rf"\textbf{{{text}}}" if cell.best else text
