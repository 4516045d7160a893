"""Where a run stands, from what it has written so far; needs neither torch nor the data."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json
from surfkit.core.lock import lock_holder
from surfkit.evaluate.metrics import read_metrics
from surfkit.runs import journal
from surfkit.runs.blocks.eta import total_seconds_left
from surfkit.runs.execute.block_state import read_state

NUMBERS = {
    "points": int,
    "losses": dict[str, float],
    "peak_memory_bytes": int,
    "peak_gpu_bytes": int,
    "psnr": dict[str, float],
    "stage": str,
}
"""What lines of the journal may have, and of what kind it is."""
STAGED = "splats"
"""The method that optimises splats in the stages of a recipe, as recipe.json has it; others have none."""
PACE_OVER = 100
"""Last steps that the speed is the mean of."""


@dataclass(frozen=True)
class BlockStatus:
    """Where one block stands.

    Attributes:
        index: Counts from 0.
        views: It is tuned on; 0 for one that stays as it is.
        status: planned, running, done or failed, as last heard of.
        step: Done.
        steps: To make.
        kind: Of the failure.
        error: Why it failed.
        attempts: How often it was begun.
        first: Step after which it was last begun.
        began: When, seconds since 1970.
        heard: When it last gave a sign of life, likewise.
        reduced: What it was given less of when memory gave out, one after the other.
    """

    index: int
    views: int
    status: str = "planned"
    step: int = 0
    steps: int = 0
    kind: str | None = None
    error: str | None = None
    attempts: int = 0
    first: int = 0
    began: float = 0.0
    heard: float = 0.0
    reduced: tuple[str, ...] = ()


SHOWN_FIELDS = tuple(field.name for field in fields(BlockStatus) if field.name not in ("index", "views"))
"""What is shown of the state of a block."""


@dataclass(frozen=True)
class Status:
    """Where a run stands.

    Attributes:
        state: "finished", "running" while a process works in the folder, else "stopped".
        process: Which one does, "process PID on HOST".
        stage: The one it is in, or was in last.
        step: Done, whether in a checkpoint or not.
        steps: Of the stage.
        saved_step: Of the last checkpoint.
        steps_per_second: Over the last steps.
        seconds_left: To the end of the stage, or of the blocks that are left, at this speed; None when nothing runs.
        points: After the last step.
        loss: Of the last step.
        peak_memory_bytes: Most memory held, by all that the run has done; as metrics.json says, once that is there.
        peak_gpu_bytes: Most memory of the GPU held, likewise; None without one.
        metrics: PSNR and SSIM of held-out photographs, at the end or when they were last looked at.
        notes: Of the run.
        skipped: Photographs that could not be read.
        blocks: Where each block stands, once they are planned.
    """

    state: str
    process: str | None = None
    stage: str | None = None
    step: int = 0
    steps: int = 0
    saved_step: int | None = None
    steps_per_second: float | None = None
    seconds_left: float | None = None
    points: int | None = None
    loss: float | None = None
    peak_memory_bytes: int | None = None
    peak_gpu_bytes: int | None = None
    metrics: dict[str, Any] | None = None
    notes: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
    blocks: tuple[BlockStatus, ...] = ()


def status(out: Path) -> Status:
    """Where the run in a folder stands.

    Raises:
        BadInput: There is no run.
    """
    recipe, record, process = out / "recipe.json", out / "run.json", lock_holder(out)
    if not recipe.exists() or not record.exists():
        doing = f"; {process} is about to begin one" if process else ""
        raise BadInput(f"{out}: no run folder (no recipe.json and run.json in it){doing}")
    kept, lines = read_json(record, dict[str, Any]), _sound(journal.read(_latest(out)))
    last, metrics = _last(lines), _metrics(out, lines)
    steps, step = last["StageBegan"].get("steps", _steps(recipe)), last["StepDone"].get("index", 0)
    finished = (out / "metrics.json").exists() and ((out / "point_cloud.ply").exists() or not _has_points(out))
    pace, blocks = _pace(lines), _blocks(out / "blocks")
    return Status(
        state="finished" if finished and not process else "running" if process else "stopped",
        process=process,
        stage=last["StageBegan"].get("stage"),
        step=step,
        steps=steps,
        saved_step=_saved(lines),
        steps_per_second=pace,
        seconds_left=_left((steps - step) / pace if pace else None, blocks) if process else None,
        points=last["StepDone"].get("points"),
        loss=_total(last["StepDone"].get("losses")),
        **_peaks(out, last["StepDone"], kept),
        metrics=metrics,
        notes=_texts(record, kept, "notes"),
        skipped=_texts(record, kept, "skipped"),
        blocks=blocks,
    )


def _latest(out: Path) -> Path:
    """The journal of the stage that the run is in: refinements have their own, as their steps are counted anew."""
    refined = (out / f"refine{at}" / journal.JOURNAL_FILE for at in itertools.count())
    return [out / journal.JOURNAL_FILE, *itertools.takewhile(Path.exists, refined)][-1]


def _blocks(folder: Path) -> tuple[BlockStatus, ...]:
    """Where the blocks of a run stand, by what lies in their folders."""
    path = folder / "plan.json"
    if not path.exists():
        return ()
    try:
        planned = read_json(path, dict[str, Any])["plan"]["blocks"]
        views = [len(block["views"]) for block in planned]
    except (KeyError, TypeError) as error:
        raise BadInput(f"{path}: damaged; delete {folder}, and the surfkit train command plans again") from error
    found = []
    for index, count in enumerate(views):
        state = read_state(folder / f"{index:03}")
        found.append(BlockStatus(index, count, **{name: getattr(state, name) for name in SHOWN_FIELDS}))
    return tuple(found)


def _left(stage: float | None, blocks: tuple[BlockStatus, ...]) -> float | None:
    """Seconds to the end of the blocks, while some are left to tune, else of the stage."""
    tuned = [block for block in blocks if block.views]
    waiting = any(block.status != "done" for block in tuned)
    found = total_seconds_left(tuned, max(block.steps for block in tuned)) if waiting else stage
    return None if found is None else round(found, 1)


def _steps(recipe: Path) -> int:
    """How many steps the first stage of a recipe has; 0 where its method tells by itself how many it makes, if any."""
    found = read_json(recipe, dict[str, Any])
    if isinstance(method := found.get("method"), dict) and method.get("use") != STAGED:
        return 0
    stage = found.get("pretrain")
    if not isinstance(stage, dict) or not isinstance(stage.get("steps"), int):
        raise BadInput(f"{recipe}: no recipe: it lacks pretrain.steps")
    return stage["steps"]


def _texts(path: Path, record: dict[str, Any], name: str) -> tuple[str, ...]:
    return tuple(load(tuple[str, ...], record.get(name, []), f"{path}: {name}"))


def _sound(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The lines without those whose numbers are none."""
    return [line for line in lines if all(_is(kind, line[key]) for key, kind in NUMBERS.items() if key in line)]


def _is(kind: Any, value: Any) -> bool:
    try:
        load(kind, value)
    except BadInput:
        return False
    return True


def _last(lines: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The last event of each kind that matters; empty if there was none."""
    return {
        kind: next((line for line in reversed(lines) if line["event"] == kind), {})
        for kind in ("StepDone", "StageBegan", "Measured")
    }


def _pace(lines: list[dict[str, Any]]) -> float | None:
    """Steps a second, over the last ones of the last attempt."""
    began = max((at for at, line in enumerate(lines) if line["event"] == "StageBegan"), default=0)
    times = [line["time"] for line in lines[began:] if line["event"] == "StepDone"][-PACE_OVER - 1 :]
    return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else None


def _saved(lines: list[dict[str, Any]]) -> int | None:
    """The step of the last checkpoint: that of the last step before it was written."""
    index = saved = None
    for line in lines:
        if line["event"] == "StepDone":
            index = line["index"]
        elif line["event"] == "FileWritten" and line.get("what") == "checkpoint":
            saved = index
    return saved


def _peaks(out: Path, step: dict[str, Any], record: dict[str, Any]) -> dict[str, int | None]:
    """Most memory held, by field of `Status`: by the last step and those before, by what is no step, which run.json
    knows, and as the end of the run was measured."""
    measured, found = read_metrics(out) if (out / "metrics.json").exists() else {}, {}
    for name, parts in (("peak_memory_bytes", "memory_bytes"), ("peak_gpu_bytes", "gpu_memory_bytes")):
        held = load(dict[str, int], record.get(parts) or {}, f"{out / 'run.json'}: {parts}")
        found[name] = max(filter(None, (step.get(name), held.get("peak"), measured.get(name))), default=None)
    return found


def _has_points(out: Path) -> bool:
    """Whether the model of a run that was measured has points."""
    return read_metrics(out)["points"] is not None


def _metrics(out: Path, lines: list[dict[str, Any]]) -> dict[str, Any] | None:
    if (out / "metrics.json").exists():
        images = read_metrics(out)["images"]
        return {"psnr": images["psnr"], "ssim": images["ssim"], "views": len(images["per_image"])}
    found = _last(lines)["Measured"]
    if not found.get("psnr"):
        return None
    values = list(found["psnr"].values())
    return {"psnr": sum(values) / len(values), "views": len(values), "step": found["index"]}


def _total(losses: dict[str, Any] | None) -> float | None:
    return None if losses is None else sum(map(float, losses.values()))


def as_json(found: Status) -> str:
    """The status as JSON."""
    from surfkit.core.codec import dump

    return json.dumps(dump(found), indent=2, ensure_ascii=False)
