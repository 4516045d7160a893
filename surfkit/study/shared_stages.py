"""Which rows of an ablation table share which stages: before they are run, and afterwards."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from surfkit.runs.run_cache import part_keys, read_shared
from surfkit.study.rows import Trial

Key = tuple[str, str]
"""Of a stage: the data set, and the hash of all settings that determine it."""


def keys_of(trial: Trial) -> dict[str, Key]:
    """By name, the key of each part of what a trial makes; the same for trials that can share it."""
    where = str(trial.data.path.resolve())
    return {name: (where, key) for name, key in part_keys(trial.recipe).items()}


def finished_keys(trials: Iterable[Trial]) -> set[Key]:
    """Keys of what the runs of some trials have put into the store, or taken from it."""
    found = set()
    for trial in trials:
        there = read_shared(trial.folder)
        found |= {key for name, key in keys_of(trial).items() if name in there}
    return found


def next_wave(waiting: Sequence[Trial], done: Collection[Key]) -> list[Trial]:
    """Those of some trials that can run at the same time without computing the same stage twice.

    Args:
        waiting: In the order of the table; the first one is always among those returned.
        done: What need not be computed.
    """
    claimed: set[Key] = set()
    wave = []
    for trial in waiting:
        needed = set(keys_of(trial).values()) - set(done)
        if not needed & claimed:
            wave.append(trial)
            claimed |= needed
    return wave


def shared_stages(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Plain data of every stage that finished trials have made or taken: its name and key, how often it was computed,
    how many runs took it, and the rows that use it, those that share a run among them."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    counted = set()
    for trial in trials:
        for name, known in read_shared(trial.folder).items():
            key = (name, known["key"])
            entry = found.setdefault(key, {"stage": name, "key": known["key"], "computed": 0, "taken": 0, "rows": []})
            if trial.label not in entry["rows"]:
                entry["rows"].append(trial.label)
            if (trial.folder, key) not in counted:
                counted.add((trial.folder, key))
                entry["taken" if known["taken"] else "computed"] += 1
    return list(found.values())


def sharing_lines(report: Mapping[str, Any]) -> list[str]:
    """A line for each stage that several runs of a table have used."""
    times = {1: "once", 2: "twice"}
    return [
        f"{stage['stage']} computed {times.get(stage['computed'], str(stage['computed']) + ' times')}, used by "
        f"{stage['computed'] + stage['taken']} runs: {', '.join(stage['rows'])}"
        for stage in report.get("stages", [])
        if stage["computed"] + stage["taken"] > 1
    ]
