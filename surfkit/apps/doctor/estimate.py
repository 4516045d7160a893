"""Memory, disk and time of a run, from what a probe has measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.apps.doctor.finding import Finding
from surfkit.apps.doctor.growth import FORECAST_SPREAD_FACTOR, Growth
from surfkit.apps.doctor.probe import ProbeResult, ProbeSegment
from surfkit.core.memory import size
from surfkit.train.data_cache import GPU_SHARE

EVENT_BYTES = 260
"""A line of events.jsonl."""
LONG_RUN_S = 48 * 3600.0
"""A run that takes longer is worth a warning."""
FIRST_LOOK_S = 2 * 3600.0
"""Before a run of recipe:surface that takes longer, a first look is worth its minutes."""
USABLE_SHARE = 0.9
"""Share of what is free that advice counts on."""
MIN_CACHE_BYTES = 200e6
"""A cache that is large enough to read ahead."""
COUNT_CAP = "pretrain.densify.filters.0:count-cap --pretrain.densify.filters.0.points"
"""What limits the number of points, before that number."""


@dataclass(frozen=True)
class FixedCosts:
    """What of a run does not depend on its points.

    Attributes:
        steps: Of the run.
        train: Photographs to train on.
        held_out: Photographs to measure on.
        view_bytes: Photographs, masks and depth priors of all training views in memory.
        budget_bytes: What the cache may hold of them.
        undistort: Photographs that are to be undistorted first.
        undistort_seconds: For one of them.
        undistort_bytes: Of one of them.
        read_seconds: To read the data set.
        read_peak_bytes: Most memory held while it was read.
        checkpoint_every: Steps between checkpoints.
        threads: That read photographs.
        movable: Whether points can be kept elsewhere than where they are drawn (`--points-on`).
    """

    steps: int
    train: int
    held_out: int
    view_bytes: int
    budget_bytes: int
    undistort: int
    undistort_seconds: float
    undistort_bytes: float
    read_seconds: float
    read_peak_bytes: int
    checkpoint_every: int
    threads: int
    movable: bool = False


@dataclass(frozen=True)
class MachineLimits:
    """What the machine has.

    Attributes:
        memory_bytes: Free, control groups respected.
        run_bytes: Free on the disk of the run folder.
        data_bytes: Free on the disk where undistorted photographs will be kept.
    """

    memory_bytes: int
    run_bytes: int
    data_bytes: int


@dataclass(frozen=True)
class GpuEstimate:
    """What a whole run will take of the memory of a GPU.

    Attributes:
        memory_bytes: Most that tensors hold.
        cache_bytes: Of that, photographs, masks and priors, which are no longer kept where it gives out.
        point_bytes: That one point more takes.
        free_bytes: What the GPU has free.
    """

    memory_bytes: int
    cache_bytes: int
    point_bytes: float
    free_bytes: int


@dataclass(frozen=True)
class MeshCosts:
    """What making a mesh takes.

    Attributes:
        seconds: Without depth maps.
        memory_bytes: Beside the points.
    """

    seconds: float
    memory_bytes: int


@dataclass(frozen=True)
class ResourceEstimate:
    """What a whole run will take.

    Attributes:
        points: At the end.
        points_known: Whether the recipe or the user sets them; else they are a rule of thumb, within a factor of 3, and
            what depends on them is as uncertain.
        seconds: Of the whole run.
        step_seconds: By part of the schedule, first to last.
        memory_bytes: Most memory held.
        cache_bytes: Of that, photographs, masks and priors.
        point_bytes: Memory that one point more takes.
        gpu: The memory of the GPU; None without one.
        run_bytes: The run folder.
        data_bytes: Undistorted photographs, beside the data set or in the user's cache.
        room: What the machine has.
        probe_seconds: That the probe took.
        movable_bytes: Points with their moments and statistics that can be kept elsewhere than where they are drawn.
        depth_seconds: Of the depth maps before, not among `seconds`; 0 where none are made, or a few do not tell.
        mesh: What making the mesh takes after it, not among `seconds`; None where none is made, or a few photographs do
            not tell.
        first: Points at the beginning.
        refine_seconds: Of what the recipe refines after it, not among `seconds`; 0 where nothing is refined.
    """

    points: int
    points_known: bool
    seconds: float
    step_seconds: tuple[float, ...]
    memory_bytes: int
    cache_bytes: int
    point_bytes: float
    run_bytes: int
    data_bytes: int
    room: MachineLimits
    probe_seconds: float = 0.0
    gpu: GpuEstimate | None = None
    movable_bytes: int = 0
    depth_seconds: float = 0.0
    mesh: MeshCosts | None = None
    first: int = 0
    refine_seconds: float = 0.0

    @property
    def whole_seconds(self) -> float:
        """From the depth maps to the mesh, as far as they are foretold."""
        mesh = 0.0 if self.mesh is None else self.mesh.seconds
        return self.depth_seconds + self.seconds + self.refine_seconds + mesh


def estimate(
    load: FixedCosts, parts: Sequence[ProbeSegment], rising: Growth, probed: ProbeResult, room: MachineLimits
) -> ResourceEstimate:
    """What a run will take, of which all parts were measured.

    Args:
        load: What does not depend on points.
        parts: As they will be in the run; the probe may have had fewer points.
        rising: How many points there will be.
        probed: What was measured; whole.
        room: What the machine has.
    """
    assert probed.started is not None and probed.written is not None
    counts = np.array([taken.points for taken in probed.taken], float)
    peaks = np.array([taken.peak_bytes for taken in probed.taken], float)
    sizes = np.array([taken.divisor for taken in probed.taken])
    point_bytes = max(slope(counts, peaks, sizes), 2.5 * probed.written.checkpoint_bytes)
    per_point = max(0.0, slope(counts, np.array([taken.seconds for taken in probed.taken]), sizes))
    step_seconds = tuple(
        taken.seconds + per_point * (part.points - taken.points)
        for part, taken in zip(parts, probed.taken, strict=True)
    )
    cached = min(load.view_bytes, load.budget_bytes)
    before = max(peaks.max(), probed.written.peak_bytes) - probed.started.held_bytes
    held = before + point_bytes * max(0, rising.last - counts.max()) + cached
    missed = 1 - cached / max(1, load.view_bytes)
    seconds = load.steps * sum(part.share * s for part, s in zip(parts, step_seconds, strict=True))
    seconds += load.steps * missed * probed.started.photo_seconds / load.threads  # readers take cores from training
    seconds += load.read_seconds + load.undistort * load.undistort_seconds / load.threads + probed.started.init_seconds
    saves = load.steps / load.checkpoint_every * probed.written.save_seconds * rising.last / counts[-1]
    seconds += saves + load.held_out * (probed.written.draw_seconds + probed.started.photo_seconds)
    on_disk = rising.last * (2 * probed.written.checkpoint_bytes + probed.written.cloud_bytes)
    on_disk += load.held_out * probed.written.picture_bytes + load.steps * EVENT_BYTES
    return ResourceEstimate(
        points=rising.last,
        points_known=rising.known,
        seconds=float(seconds),
        step_seconds=tuple(float(s) for s in step_seconds),
        memory_bytes=int(max(held, load.read_peak_bytes)),
        cache_bytes=int(cached),
        point_bytes=float(point_bytes),
        run_bytes=int(on_disk),
        data_bytes=int(load.undistort * load.undistort_bytes),
        room=room,
        gpu=_on_gpu(load, rising, probed, free) if (free := probed.started.gpu_free_bytes) else None,
        movable_bytes=int(rising.last * probed.written.checkpoint_bytes) if load.movable else 0,
    )


def _on_gpu(load: FixedCosts, rising: Growth, probed: ProbeResult, free: int) -> GpuEstimate:
    counts, peaks, sizes = (
        np.array(each, float) for each in zip(*((t.points, t.gpu_bytes, t.divisor) for t in probed.taken), strict=True)
    )
    each = max(0.0, slope(counts, peaks, sizes))
    held = int(peaks.max() + each * max(0, rising.last - counts.max()))
    cached = min(load.view_bytes, int(GPU_SHARE * free))
    return GpuEstimate(held + cached, cached, each, free)


def slope(x: np.ndarray, y: np.ndarray, group: np.ndarray) -> float:
    """How fast y rises with x, by least squares within groups that differ by a constant; 0 where x does not vary.

    Photographs of another size cost another time and other memory, which is no matter of points.
    """
    _, at = np.unique(group, return_inverse=True)
    centred = x - (np.bincount(at, x) / np.bincount(at))[at]
    square = float((centred**2).sum())
    return float((centred * y).sum()) / square if square > 0 else 0.0


def advice(found: ResourceEstimate) -> list[Finding]:
    """What to lower where a run will not fit, or take days."""
    return [*_memory(found), *_gpu_memory(found), *_disk(found), *_time(found)]


def first_look(found: ResourceEstimate) -> list[Finding]:
    """The recipe for a first look, where one that begins at stereo depth takes hours."""
    if (seconds := found.whole_seconds) <= FIRST_LOOK_S:
        return []
    text = f"the run will take about {duration(seconds)}; recipe:surface-short --steps 500 is a first look"
    return [Finding("note", "first-look", text)]


def _gpu_memory(found: ResourceEstimate) -> list[Finding]:
    gpu = found.gpu
    if gpu is None or (rest := gpu.memory_bytes - gpu.cache_bytes) <= (free := USABLE_SHARE * gpu.free_bytes):
        return []
    likely = "" if found.points_known else f" with the {found.points:,} points that are likely"
    text = (
        f"the run will take about {size(rest)} of the memory of the GPU{likely}, and {size(free)} can be used: smaller "
        "photographs (--scale 2) need less"
    )
    fewer = found.points - (rest - free) / max(gpu.point_bytes, 1)
    if fewer > 0.1 * found.points:
        text += f", and so do fewer points: {COUNT_CAP} {one_digit(fewer)}"
    moved = found.movable_bytes
    if moved and rest - moved <= free:
        left = f"leaves at most {size(max(0, rest - moved))} there"
        if found.memory_bytes - found.cache_bytes + moved <= USABLE_SHARE * found.room.memory_bytes:
            text += f"; --points-on host {left}, and takes {size(moved)} of the memory of the CPU"
        elif _fits_disk(found):
            text += f"; --points-on disk {left}, and takes {size(moved)} of the disk"
    return [Finding("warning", "gpu-memory", text)]


def _fits_disk(found: ResourceEstimate) -> bool:
    """Whether there are points that can be kept in files, and the disk of the run folder has room for them."""
    return 0 < found.movable_bytes <= USABLE_SHARE * found.room.run_bytes - found.run_bytes


def _memory(found: ResourceEstimate) -> list[Finding]:
    free = USABLE_SHARE * found.room.memory_bytes
    if found.memory_bytes <= free:
        return []
    rest = found.memory_bytes - found.cache_bytes
    likely = "" if found.points_known else f" with the {found.points:,} points that are likely"
    text = f"the run will take about {size(found.memory_bytes)} of memory{likely}, and {size(free)} can be used: "
    if found.cache_bytes and rest + MIN_CACHE_BYTES < free:
        text += f"use --cache {size(free - rest, 0).replace(' ', '')}, which is slower and gives the same result"
    else:
        fewer = found.points - (rest + MIN_CACHE_BYTES - free) / max(found.point_bytes, 1)
        text += "smaller photographs (--scale 2) need less"
        if fewer > 0.1 * found.points:
            text += f", and so do fewer points: {COUNT_CAP} {one_digit(fewer)}"
        least = f" with --cache {size(MIN_CACHE_BYTES, 0).replace(' ', '')}"
        text += least
        left = rest - found.movable_bytes + MIN_CACHE_BYTES
        if found.gpu is None and left <= free and _fits_disk(found):
            text += (
                f"; --points-on disk{least} takes at most {size(left)} of memory and {size(found.movable_bytes)} of "
                "the disk, with the same result"
            )
    return [Finding("warning", "memory", text)]


def _disk(found: ResourceEstimate) -> list[Finding]:
    where = [
        ("run-folder-disk", "the run folder", found.run_bytes, found.room.run_bytes),
        ("undistorted-disk", "undistorted photographs", found.data_bytes, found.room.data_bytes),
    ]
    return [
        Finding(
            "warning",
            what,
            f"{name} will take about {size(need)} of disk, and {size(free)} are free: make room, put the run folder on "
            "another disk (--out), or use smaller photographs (--scale 2)",
        )
        for what, name, need, free in where
        if need > USABLE_SHARE * free
    ]


def _time(found: ResourceEstimate) -> list[Finding]:
    if found.whole_seconds <= LONG_RUN_S:
        return []
    text = (
        f"the run will take about {duration(found.whole_seconds)}: --steps shortens it with every schedule scaled "
        "along, and --scale 2 makes each step about four times faster"
    )
    return [Finding("warning", "time", text)]


def duration(seconds: float) -> str:
    """Seconds in words: 2 days 3 h, 3 h 20 min, 12 min, 40 s."""
    minutes = round(seconds / 60)
    if minutes >= 48 * 60:
        return f"{minutes // 1440} days {minutes % 1440 // 60} h"
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min" if minutes >= 2 else f"{seconds:.0f} s"


def one_digit(count: float) -> int:
    """A number above 0, rounded down to its first digit."""
    unit = 10 ** (len(str(int(count))) - 1)
    return max(1, int(count) // unit * unit)


def likely_range(found: ResourceEstimate) -> str:
    """The number of points in words."""
    if found.points_known:
        return f"{found.points:,}"
    least, most = found.points / FORECAST_SPREAD_FACTOR, found.points * FORECAST_SPREAD_FACTOR
    return f"{found.points:,} likely, {least:,.0f} to {most:,.0f} possible"
