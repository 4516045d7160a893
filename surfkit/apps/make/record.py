"""make.json: what a delivery is made from, what was decided, and which steps are finished."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput, Fault
from surfkit.core.codec import read_json, write_json
from surfkit.runs.run_notes import hear_warnings

MAKE_RECORD = "make.json"


@dataclass
class FinishedStep:
    """One step of the way.

    Attributes:
        folder: Where it writes, inside the delivery.
        key: Of what its result depends on.
        seconds: That it took, all calls together.
        complete: Whether it came to its end.
        files: What it wrote, inside the delivery.
        notes: Its warnings, those of earlier calls too.
    """

    folder: str
    key: str = ""
    seconds: float = 0.0
    complete: bool = False
    files: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass
class Forecast:
    """What was measured beforehand, of the optimisation alone; of all else a guess.

    Attributes:
        seconds: Of the optimisation.
        memory_bytes: The same.
        disk_bytes: Of the model.
        other_seconds: Of depth maps and mesh, as measured on a few photographs, and a guess for texture, maps and
            reports; None on a GPU, and where the mesh cannot be foretold.
        mesh_bytes: Memory that making the mesh takes beside the points; None where it cannot be foretold.
    """

    seconds: float
    memory_bytes: int
    disk_bytes: int
    other_seconds: float | None = None
    mesh_bytes: int | None = None


@dataclass
class Decisions:
    """What was decided for a scene.

    Attributes:
        recipe: Name of the recipe.
        why: The rule that chose it.
        photographs: That are trained on.
        steps: Of optimisation.
        blocks: Blocks along each side, where the scene is divided.
        points: Most points of the coarse model, where the scene is divided.
        forecast: None where none could be made.
        mesher: Name of the method that makes the mesh; None for that of the recipe.
    """

    recipe: str
    why: str
    photographs: int
    steps: int
    blocks: int | None = None
    points: int | None = None
    forecast: Forecast | None = None
    mesher: str | None = None

    def longer(self, steps: int) -> Decisions:
        """The same with another number of steps, whose time follows from what was measured."""
        told = self.forecast
        if told is not None:
            told = replace(told, seconds=round(told.seconds * steps / self.steps, 1))
        return replace(self, steps=steps, forecast=told)


@dataclass
class MakeRecord:
    """What make.json holds.

    Attributes:
        input: The data set, the folder of photographs, or the video.
        quality: The preset.
        reading: How photographs are read, as plain data.
        decisions: None until the cameras are known.
        left_out: Reasons, by what is left out.
        steps: By name, in their order.
        files: What a client opens, by what it is; inside the delivery.
        versions: Of surfkit and of what it runs on.
        folder: Of the delivery: what has moved with it is found again.
    """

    input: str
    quality: str
    reading: dict[str, Any]
    decisions: Decisions | None = None
    left_out: dict[str, str] = field(default_factory=dict)
    steps: dict[str, FinishedStep] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    folder: str = ""


class Delivery:
    """The folder of a delivery, whose make.json is written after each change.

    Args:
        out: The folder.
        record: What make.json says, or is to say.
        command: That goes on.
    """

    def __init__(self, out: Path, record: MakeRecord, command: str) -> None:
        self.out, self.record, self.command = out, record, command

    def write(self) -> None:
        """Save make.json."""
        write_json(self.out / MAKE_RECORD, self.record)

    def is_done(self, name: str, key: str) -> bool:
        """Whether a step is finished with the same key, and its files are there."""
        step = self.record.steps.get(name)
        if step is None or not step.complete or step.key != key:
            return False
        return all((self.out / file).exists() for file in step.files)

    def run(self, name: str, folder: Path, key: str, work: Callable[[], Sequence[Path]]) -> None:
        """Do a step, and keep its time; an error is told with the name of the step.

        Args:
            name: Of the step.
            folder: Where it writes.
            key: Of what its result depends on.
            work: Does it, and returns the files that it wrote; what an interrupted call did is not done again.
        """
        before = self.record.steps.get(name)
        was_done = before is not None and before.complete and before.key == key
        same = before if before is not None and before.key == key else FinishedStep("")
        spent, step = same.seconds, FinishedStep(folder.relative_to(self.out).as_posix(), key, same.seconds)
        self.record.steps[name] = step
        began = time.perf_counter()
        try:
            with hear_warnings() as heard:
                step.files = tuple(path.relative_to(self.out).as_posix() for path in work())
            step.complete = True
        except (BadInput, Fault) as error:
            error.args = (f"step {name}: {error}; finished steps are kept: then `{self.command}` goes on",)
            raise
        finally:
            if not (was_done and step.complete):  # to look whether it is finished is not counted
                step.seconds = round(spent + time.perf_counter() - began, 1)
            step.notes = tuple(dict.fromkeys([*same.notes, *heard]))
            self.write()


def read_record(out: Path) -> MakeRecord | None:
    """What make.json of a delivery says; None if there is none.

    Raises:
        BadInput: It is damaged.
    """
    path = out / MAKE_RECORD
    if not path.exists():
        return None
    try:
        return read_json(path, MakeRecord)
    except BadInput as error:
        raise BadInput(f"{error}; put the file back as surfkit wrote it, or name another folder with --out") from error
