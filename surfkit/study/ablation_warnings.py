"""What the rows of an ablation table are warned of: before they are run, and afterwards."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

from surfkit.io.datasets.depth_prior import SWITCHED_OFF, prepare_command, prior_files
from surfkit.io.datasets.read import read
from surfkit.runs.folder import Run, read_record
from surfkit.study.rows import Trial


def lines_on_depth(trials: Sequence[Trial], labels: Sequence[str]) -> list[str]:
    """A line for each data set without depth maps: the rows that want some and do not make them, and what happens then.

    Args:
        trials: That are to be run.
        labels: Of all rows of the table.
    """
    found = []
    for data in dict.fromkeys(trial.data for trial in trials):
        wanting = [trial for trial in trials if trial.data == data and _wants_maps(trial)]
        if not wanting or prior_files(data, read(data)):
            continue
        rows = row_numbers({trial.label for trial in wanting}, labels)
        fail = {each.label for each in wanting if each.recipe.method.needs_prior or each.recipe.start.needs_prior}
        begin = f"; {row_numbers(fail, labels)} will fail, as training begins at depth maps" if fail else ""
        make = prepare_command(data)
        found.append(f"{data.path} has no depth priors, so {SWITCHED_OFF}, in {rows}{begin}; {make}")
    return found


def _wants_maps(trial: Trial) -> bool:
    return trial.recipe.depth is None and Run(trial.folder, trial.recipe, trial.data).wants_priors


def lacked_maps(trial: Trial) -> bool:
    """Whether a run was to learn from depth maps, and had none, so that it is not what its row is named after."""
    return _wants_maps(trial) and any(SWITCHED_OFF in note for note in read_record(trial.folder).get("notes", []))


def notes_of(trials: Iterable[Trial]) -> list[dict[str, Any]]:
    """Plain data of each note in the records of some runs, stated once: its "text", and the "rows" with such a run.

    Where runs were made on several devices, that is a note, too.
    """
    found: dict[str, list[str]] = {}
    devices: dict[str, list[str]] = {}
    for trial in trials:
        record = read_record(trial.folder)
        where = [f"{record['device']}, threads: {record.get('threads')}"] if "device" in record else []
        for into, texts in ((found, record.get("notes", [])), (devices, where)):
            for text in texts:
                rows = into.setdefault(text, [])
                rows += [] if trial.label in rows else [trial.label]
    if len(devices) > 1:  # the table went on elsewhere
        for device, rows in devices.items():
            found[f"trained on {device}: minutes and FPS compare with such rows only"] = rows
    return [{"text": text, "rows": rows} for text, rows in found.items()]


def row_numbers(chosen: Collection[str], labels: Sequence[str]) -> str:
    """Some rows of a table by their numbers, such as "row 3", "rows 1 to 4 and 7" or "all rows".

    Args:
        chosen: Their labels.
        labels: Of all rows.
    """
    at = [number for number, label in enumerate(labels, 1) if label in chosen]
    if len(at) == len(labels):
        return "all rows"
    if len(at) == 1:
        return f"row {at[0]}"
    firsts = [number for number in at if number - 1 not in at]
    lasts = [number for number in at if number + 1 not in at]
    parts: list[str] = []
    for first, last in zip(firsts, lasts, strict=True):
        parts += [f"{first} to {last}"] if last - first > 1 else map(str, range(first, last + 1))
    return f"rows {' and '.join(filter(None, [', '.join(parts[:-1]), parts[-1]]))}"
