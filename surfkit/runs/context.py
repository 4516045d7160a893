"""What all stages of a run are given."""

from __future__ import annotations

from dataclasses import dataclass

from surfkit.raster.base import Rasterizer
from surfkit.runs.folder import Run
from surfkit.runs.run_cache import RunCache
from surfkit.runs.run_stage import Intervals
from surfkit.scene.scene import Scene
from surfkit.train.data_cache import CacheSettings


@dataclass(frozen=True)
class RunContext:
    """A run, and what its stages are computed with.

    Attributes:
        run: The run.
        scene: Its data; in a worker, those of its block.
        rasterizer: What draws.
        intervals: Steps between checkpoints and between pictures.
        caches: Where photographs are cached.
        shares: What the run shares with others; nothing in a worker.
    """

    run: Run
    scene: Scene
    rasterizer: Rasterizer
    intervals: Intervals
    caches: CacheSettings
    shares: RunCache | None = None

    def keep(self, part: str) -> None:
        """Put a finished part of the run where others find it, if the run shares any."""
        if self.shares is not None:
            self.shares.keep(part)
