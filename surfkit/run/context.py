"""What all stages of a run are given."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from surfkit.raster.api import Rasterizer
from surfkit.run.folder import Run
from surfkit.run.stage import Intervals
from surfkit.scene.scene import Scene
from surfkit.train.material import CacheSettings


@dataclass(frozen=True)
class RunContext:
    """Where blocks are worked on.

    Attributes:
        run: The run.
        scene: Its data, or those of the block that is worked on.
        rasterizer: What draws.
        intervals: When a block writes what.
        caches: Where its photographs are kept at hand.
    """

    run: Run
    scene: Scene
    rasterizer: Rasterizer
    intervals: Intervals
    caches: CacheSettings

    @property
    def folder(self) -> Path:
        """Of all blocks."""
        return self.run.out / "blocks"

    def place(self, index: int) -> Path:
        """The folder of one block."""
        return self.folder / f"{index:03}"

    def views(self, index: int) -> Path:
        """Where the views of a block are."""
        return views_file(self.run.out, index)

    def folders(self) -> list[Path]:
        """Those of the blocks that somebody has begun."""
        return sorted(self.folder.glob("[0-9]*"))

    def block(self, index: int) -> Run:
        """One block as a run of its own."""
        return Run(self.place(index), self.run.recipe, self.run.data, "tune", index)


def views_file(out: Path, index: int) -> Path:
    """Where the views of a block of a run are, so that nobody need read the data set to tune it."""
    return out / "blocks" / f"{index:03}" / "views.npz"
