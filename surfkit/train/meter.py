"""What the memory of a run is taken by."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from surfkit.core.memory import peak_memory_bytes, resident_bytes
from surfkit.train.material import TrainingData
from surfkit.train.stage import StageState


class Meter:
    """Splits the most memory that was held into parts, in bytes, which add up to it.

    The program and the scene are what the process held before and more of it after reading the data. Points with their
    moments, and what the caches keep, are counted: the most of each. Writing checkpoints and drawing pictures or
    measuring count by what they add to the most that was held until then. All else is taken by the steps: the
    rasterizer, gradients, losses, and photographs while they are decoded.
    """

    def __init__(self) -> None:
        self.parts = {"program": resident_bytes(), "scene": 0, "points": 0}
        self.caches: dict[str, int] = {}
        self.added = {"checkpoints": 0, "pictures": 0}

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
        before = peak_memory_bytes()
        try:
            yield
        finally:
            self.added[part] += peak_memory_bytes() - before

    def report(self) -> dict[str, int]:
        """The peak, and its parts by name."""
        peak = peak_memory_bytes()
        parts = {**self.parts, **self.caches, **self.added}
        rest = peak - sum(parts.values())
        parts["program"] += min(0, rest)  # what it had let go of again was taken by others
        return {"peak": peak, **parts, "steps": max(0, rest)}
