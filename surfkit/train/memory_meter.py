"""What the memory of a run is taken by, on the CPU and on the GPU."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from surfkit.core.events import MemoryTaken, emit
from surfkit.core.memory import (
    highest_memory_bytes,
    mapped_bytes,
    peak_memory_bytes,
    reset_peak_memory,
    resident_bytes,
)
from surfkit.primitives.storage import DiskStorage
from surfkit.raster.nvrtc.gpu_memory import peak_gpu_bytes, reset_peak_gpu
from surfkit.train.data_cache import TrainingData
from surfkit.train.state import StageState
from surfkit.train.uploads import Uploads


class MemoryMeter:
    """Splits the most memory that was held since it was made into parts, in bytes, which add up to it.

    The peak of the process counts anew from then on, so that what was held before, such as by another run, does not
    count. Where the system cannot do that, there is no report until more is held than ever before.

    The program and the scene are what the process held before and more of it after reading the data. Points with their
    moments, and what the caches keep, are counted: the most of each. Writing checkpoints and drawing pictures or
    measuring count by what they add to the most that was held until then. All else is taken by the steps: the
    rasterizer, gradients, losses, and photographs while they are decoded. The memory of a GPU is split likewise. Of
    points on the disk, what is in memory counts, though the system takes that back where it needs it.
    """

    def __init__(self) -> None:
        reset_peak_memory()
        reset_peak_gpu()
        self.mapped = mapped_bytes()
        self.gpu = {"points": 0, "photographs": 0}
        self.parts = {"program": resident_bytes(), "scene": 0, "points": 0}
        self.caches: dict[str, int] = {}
        self.added = {"checkpoints": 0, "pictures": 0}

    @classmethod
    def of_stage(cls) -> MemoryMeter:
        """A meter of a stage within a run; what the run has held since the meter before is emitted."""
        peak, on_gpu = peak_memory_bytes(), peak_gpu_bytes()
        if peak or on_gpu:
            gpu = {"peak": on_gpu, "steps": on_gpu} if on_gpu else {}
            emit(MemoryTaken({"peak": peak, "program": peak} if peak else {}, gpu))
        return cls()

    def scene_read(self) -> None:
        """The scene has just been read."""
        self.parts["scene"] = max(0, resident_bytes() - self.parts["program"])

    def step(self, state: StageState, data: TrainingData, uploads: Uploads) -> None:
        """See what is held after a step."""
        beside = sum(value.nbytes for group in (state.frozen, state.appearances) for value in group.values())
        points = state.points.nbytes + beside
        where = self.gpu if state.points.device.type == "cuda" else self.parts
        if isinstance(state.points.storage, DiskStorage):  # in memory is what was looked at
            points = min(points, max(0, mapped_bytes() - self.mapped))
        where["points"] = max(where["points"], points)
        self.gpu["photographs"] = max(self.gpu["photographs"], uploads.bytes)
        for name, count in data.bytes().items():
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
        report, gpu = self.report(), self.gpu_report()
        if report or gpu:
            emit(MemoryTaken(report, gpu))

    def report(self) -> dict[str, int]:
        """The peak, and its parts by name; empty where it is not known."""
        peak = peak_memory_bytes()
        if not peak:
            return {}
        return _split(peak, {**self.parts, **self.caches, **self.added})

    def gpu_report(self) -> dict[str, int]:
        """The same of the GPU; empty where nothing has been held on one."""
        peak = peak_gpu_bytes()
        return _split(peak, self.gpu) if peak else {}


def _split(peak: int, held: Mapping[str, int]) -> dict[str, int]:
    """The peak, and its parts: what was held, and the rest as that of the steps."""
    parts = {**held, "steps": 0}
    rest = peak - sum(parts.values())
    parts["steps"] = max(0, rest)
    for name, count in parts.items():  # what one had let go of again was taken by others
        cut = min(count, max(0, -rest))
        parts[name], rest = count - cut, rest + cut
    return {"peak": peak, **parts}
