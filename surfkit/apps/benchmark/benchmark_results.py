"""What a benchmark has come to: plain data, and as a table for a terminal, Markdown and CSV."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import platform
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from surfkit.apps.benchmark.protocol import MEAN, BenchmarkScene, Contender, Protocol
from surfkit.apps.benchmark.provenance import Provenance, commit
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, read_keys, write_json, write_text
from surfkit.core.version import own_version
from surfkit.study.metric_columns import TABLE_COLUMNS

LEGEND = "In brackets: the published figure. With several seeds: mean ± standard deviation."
RESULTS_FILE = "benchmark.json"
"""In the folder of a benchmark: all of its results."""
PARTS = ("surfkit", "commit", "torch", "device", "data")
"""Of the provenance of a run, those that are shown."""


def results_in(out: Path, protocol: Protocol) -> dict[str, Any] | None:
    """The results of a protocol that a folder has; None if it has none.

    Raises:
        BadInput: They are of another protocol, or of another declaration of this one, or no results.
    """
    path, remedy = out / RESULTS_FILE, "name another folder, or delete that one"
    if not path.exists():
        return None
    hints = {"benchmark": str, "protocol": dict[str, Any], "data": dict[str, Any], "versions": dict[str, Any]}
    known = read_keys(path, hints, remedy)
    if known["benchmark"] != protocol.tag:
        raise BadInput(f"--out {out} has results of {known['benchmark']}, and this is {protocol.tag}; {remedy}")
    if known["protocol"].get("digest") != protocol.digest:
        raise BadInput(f"--out {out} has results of {protocol.tag} by another declaration of that version; {remedy}")
    return read_json(path, dict[str, Any])


def report_of(
    protocol: Protocol,
    seeds: int,
    scenes: Mapping[str, tuple[str, Mapping[str, Any]]],
    made: Mapping[str, Provenance],
    before: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Plain data of a benchmark as far as it has been run.

    Args:
        protocol: Its protocol.
        seeds: Runs of each row.
        scenes: By name, hash of the data and what is known of the rows, as `study.report_of` has it.
        made: Provenance by folder of a run.
        before: The results of an earlier command, whose other rows and scenes are kept where they still count.
    """
    rows = [
        scene_row(protocol, name, row, made)
        for name, (_, report) in scenes.items()
        for row in report["data_sets"][0]["rows"]
    ]
    rows += still_valid(protocol, before, rows)
    order = [scene.name for scene in protocol.scenes]
    rank = {each.label: at for at, each in enumerate(protocol.contenders)}  # other recipes stand below
    rows.sort(key=lambda row: (order.index(row["scene"]), rank.get(row["recipe"], len(rank))))
    shown = {row["scene"] for row in rows}
    if len(protocol.scenes) > 1:
        means = [mean_row(protocol, label, rows) for label in dict.fromkeys(row["recipe"] for row in rows)]
        rows += [row for row in means if row["mean"] or row["published"]]
    data = dict(before["data"] if before else {}) | {name: found for name, (found, _) in scenes.items()}
    return {
        "benchmark": protocol.tag,
        "about": protocol.about,
        "protocol": {"name": protocol.name, "version": protocol.version, "digest": protocol.digest},
        "published_in": protocol.published_in,
        "columns": list(protocol.columns),
        "seeds": seeds,
        "versions": {
            "surfkit": own_version(),
            "commit": commit(),
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        "data": {name: data[name] for name in order if name in shown},
        "rows": rows,
        "notes": list(
            dict.fromkeys(
                f"{name}: {note['text']} ({', '.join(note['rows'])})"
                for name, (_, report) in scenes.items()
                for note in report["data_sets"][0]["notes"]
            )
        ),
    }


def still_valid(
    protocol: Protocol, before: Mapping[str, Any] | None, rows: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Rows of an earlier command that are not among those of now, and that the same command would not train again."""
    if before is None:
        return []
    now, known = {(row["scene"], row["recipe"]) for row in rows}, {scene.name: scene for scene in protocol.scenes}
    kept = []
    for row in before["rows"]:
        if row["scene"] not in known or (row["scene"], row["recipe"]) in now or not row["runs"]:
            continue
        try:
            (contender,) = protocol.chosen_contenders([row["recipe"]])
            digest = recipe_digest(protocol, contender, known[row["scene"]])
        except BadInput:  # its plugin is gone
            continue
        own = all((run["made"] or {}).get("surfkit") == own_version() for run in row["runs"])
        kept += [dict(row)] if own and digest == row["recipe_digest"] else []
    return kept


def recipe_digest(protocol: Protocol, contender: Contender, scene: BenchmarkScene) -> str:
    """Twelve hex digits of what a row trains."""
    recipe = replace(protocol.recipe(contender, scene), about="")
    return hashlib.sha256(json.dumps(dump(recipe), sort_keys=True).encode()).hexdigest()[:12]


def scene_row(protocol: Protocol, scene: str, row: Mapping[str, Any], made: Mapping[str, Provenance]) -> dict[str, Any]:
    """Plain data of a row on a scene."""
    runs = []
    (contender,), (place,) = protocol.chosen_contenders([row["label"]]), protocol.chosen_scenes([scene])
    for each in row["runs"]:
        folder = f"{scene}/{each['folder']}"
        runs.append(each | {"folder": folder, "made": dump(made[folder]) if folder in made else None})
    return {
        "scene": scene,
        "recipe": row["label"],
        "recipe_digest": recipe_digest(protocol, contender, place),
        "mean": row["mean"],
        "sd": row["sd"],
        "published": row["paper"],
        "runs": runs,
        "failed": row["failed"] or row["not_as_named"],
    }


def mean_row(protocol: Protocol, label: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Plain data of the means over all scenes of the protocol, of the figures that are there for all."""
    own = {row["scene"]: row["mean"] for row in rows if row["recipe"] == label}
    published = {name: it for each in protocol.contenders if each.label == label for name, it in each.published.items()}
    whole = all(scene.name in own for scene in protocol.scenes)
    names = [name for name in TABLE_COLUMNS if whole and all(name in mean for mean in own.values())]
    return {
        "scene": MEAN,
        "recipe": label,
        "mean": {name: statistics.fmean(mean[name] for mean in own.values()) for name in names},
        "sd": dict.fromkeys(names),
        "published": dict(published.get(MEAN, {})),
        "runs": [],
        "failed": None,
    }


def write_report(out: Path, protocol: Protocol, report: Mapping[str, Any]) -> None:
    """Write the results as JSON, Markdown and CSV."""
    write_json(out / RESULTS_FILE, report)
    write_text(out / "benchmark.md", markdown(protocol, report))
    write_text(out / "benchmark.csv", comma_separated(report))


def shown_columns(report: Mapping[str, Any]) -> list[str]:
    """Those of the protocol that a row has a figure of, measured or published."""
    return [name for name in report["columns"] if any(name in {**r["mean"], **r["published"]} for r in report["rows"])]


def head_and_cells(report: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """The table as texts: our figures, and in brackets the published ones."""
    names = shown_columns(report)
    head = ["scene", "recipe", "seeds", *(TABLE_COLUMNS[name].head for name in names)]
    return head, [
        [row["scene"], row["recipe"], str(len(row["runs"]) or ""), *(cell(row, name) for name in names)]
        for row in report["rows"]
    ]


def cell(row: Mapping[str, Any], name: str) -> str:
    """A figure of a row, and the published one."""
    column, published = TABLE_COLUMNS[name], row["published"].get(name)
    own = "-" if name not in row["mean"] else column.text(row["mean"][name], row["sd"].get(name))
    return own if published is None else f"{own} ({column.text(published)})"


def facts(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What the figures were made with and from, each with its values; several where runs differ."""
    made = [(row["scene"], run["made"]) for row in report["rows"] for run in row["runs"] if run["made"]]
    found = [("protocol", f"{report['benchmark']} (digest {report['protocol']['digest']})")]
    for part in PARTS[:-1]:
        values = list(dict.fromkeys(str(each[part]) for _, each in made if each[part] is not None))
        found += [(part, "; ".join(values))] if values else []
    return [*found, ("data", ", ".join(f"{name} {data}" for name, data in report["data"].items()))]


def failures(report: Mapping[str, Any]) -> list[str]:
    """A line for each row that failed."""
    return [f"{row['scene']}, {row['recipe']}: {row['failed']}" for row in report["rows"] if row["failed"]]


def markdown(protocol: Protocol, report: Mapping[str, Any]) -> str:
    """The results as a page."""
    from surfkit.apps.benchmark.protocol_words import description

    head, rows = head_and_cells(report)
    marks = ["---", "---", *["---:"] * (len(head) - 2)]
    table = ["| " + " | ".join(text.replace("|", "\\|") for text in row) + " |" for row in [head, marks, *rows]]
    told = [f"- {text}" for text in (*failures(report), *report["notes"])]
    source = f" Published figures: {protocol.published_in}." if protocol.published_in else ""
    page = [
        f"# {report['benchmark']}",
        report["about"] + ".",
        "\n".join(f"- {name}: {value}" for name, value in facts(report)),
        "\n".join(table),
        LEGEND + source,
        "\n".join(told),
        "## The protocol",
        "\n".join(f"- {line}" for line in description(protocol)),
    ]
    return "\n\n".join(part for part in page if part) + "\n"


def comma_separated(report: Mapping[str, Any]) -> str:
    """A line for each run, with plain numbers in seconds, bytes and counts, and the published figures of its row."""
    names, text = report["columns"], io.StringIO()
    published = [f"published_{name}" for name in names]
    header = ["benchmark", "scene", "recipe", "seed", "folder", *PARTS, *names, *published, "failed"]
    writer = csv.DictWriter(text, header, restval="", lineterminator="\n")
    writer.writeheader()
    for row in report["rows"]:
        about = {
            "benchmark": report["benchmark"],
            "scene": row["scene"],
            "recipe": row["recipe"],
            "failed": row["failed"] or "",
            **{f"published_{name}": it for name, it in row["published"].items() if name in names},
        }
        for run in row["runs"] or [row["mean"]]:
            own = {name: run[name] for name in ("seed", "folder", *names) if name in run}
            writer.writerow(about | own | {part: (run.get("made") or {}).get(part) or "" for part in PARTS})
    return text.getvalue()
