"""What the memory of a run is taken by."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from surfkit.core.events import MemoryTaken, emit
from surfkit.core.memory import highest_memory_bytes, peak_memory_bytes, reset_peak_memory, resident_bytes
from surfkit.train.material import TrainingData
from surfkit.train.state import StageState


class Meter:
    """Splits the most memory that was held since it was made into parts, in bytes, which add up to it.

    The peak of the process counts anew from then on, so that what was held before, such as by another run, does not
    count. Where the system cannot do that, there is no report until more is held than ever before.

    The program and the scene are what the process held before and more of it after reading the data. Points with their
    moments, and what the caches keep, are counted: the most of each. Writing checkpoints and drawing pictures or
    measuring count by what they add to the most that was held until then. All else is taken by the steps: the
    rasterizer, gradients, losses, and photographs while they are decoded.
    """

    def __init__(self) -> None:
        reset_peak_memory()
        self.parts = {"program": resident_bytes(), "scene": 0, "points": 0}
        self.caches: dict[str, int] = {}
        self.added = {"checkpoints": 0, "pictures": 0}

    @classmethod
    def of_stage(cls) -> Meter:
        """A meter of a stage within a run; what the run has held since the meter before is emitted."""
        if peak := peak_memory_bytes():
            emit(MemoryTaken({"peak": peak, "program": peak}))
        return cls()

    def scene_read(self) -> None:
        """The scene has just been read."""
        self.parts["scene"] = max(0, resident_bytes() - self.parts["program"])

    def step(self, state: StageState, material: TrainingData) -> None:
        """See what is held after a step."""
        groups = (*vars(state.points).values(), state.frozen, state.looks)
        points = sum(value.nbytes for group in groups for value in group.values())
        self.parts["points"] = max(self.parts["points"], points)
        for name, count in material.bytes().items():
            self.caches[name] = max(self.caches.get(name, 0), count)

    @contextmanager
    def adding(self, part: str) -> Iterator[None]:
        """Within, what is added to the peak belongs to a part."""
        before = highest_memory_bytes()
        try:
            yield
        finally:
            self.added[part] += highest_memory_bytes() - before

    def tell(self) -> None:
        """Emit the report, where the peak is known."""
        if report := self.report():
            emit(MemoryTaken(report))

    def report(self) -> dict[str, int]:
        """The peak, and its parts by name; empty where it is not known."""
        peak = peak_memory_bytes()
        if not peak:
            return {}
        parts = {**self.parts, **self.caches, **self.added, "steps": 0}
        rest = peak - sum(parts.values())
        parts["steps"] = max(0, rest)
        for name, held in parts.items():  # what one had let go of again was taken by others
            cut = min(held, max(0, -rest))
            parts[name], rest = held - cut, rest + cut
        return {"peak": peak, **parts}
