"""An ablation table for other programs: one line a row, data set and seed, with plain numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

from surfkit.study.metric_columns import TABLE_COLUMNS
from surfkit.study.table_text import data_names, data_sets

CSV_HEADER = (
    "table",
    "data",
    "number",
    "row",
    "built_on",
    "kept",
    "seed",
    "folder",
    *TABLE_COLUMNS,
    "failed",
    "not_as_named",
)


def comma_separated(report: Mapping[str, Any]) -> str:
    """Every run of the table in seconds, bytes and counts; a row without any run is a line without numbers."""
    text = io.StringIO()
    writer = csv.DictWriter(text, CSV_HEADER, restval="", lineterminator="\n")
    writer.writeheader()
    for data, entry in zip(data_names(report), data_sets(report), strict=True):
        for row in entry["rows"]:
            facts = {
                "table": report["table"],
                "data": data,
                "number": row["number"],
                "row": row["label"],
                "built_on": row["built_on"] or "",
                "kept": str(row["kept"]).lower(),
                "failed": row["failed"] or "",
                "not_as_named": row.get("not_as_named") or "",
            }
            for run in row["runs"] or [{}]:
                writer.writerow(facts | {name: run[name] for name in CSV_HEADER if name in run})
    return text.getvalue()
