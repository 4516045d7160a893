"""What the steps of a stage work with: the stage, the views, and what draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from surfkit.core.schedule import LearningRate
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.primitives.base import Primitive
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.points import Points
from surfkit.primitives.storage import Storage
from surfkit.raster.base import Rasterizer
from surfkit.scene.scene import View
from surfkit.train.exchange import DividedRasterizer
from surfkit.train.neighbour_selector import NeighbourSelector
from surfkit.train.processes import Processes
from surfkit.train.stage import Stage, rates_of
from surfkit.train.uploads import TrainingPhotos, Uploads


@dataclass(frozen=True)
class StageSetup:
    """A stage and all it runs on; nothing of it changes from step to step but what `uploads` keeps at hand.

    Attributes:
        stage: What to do.
        primitive: What the points are.
        views: Photographs to optimise on.
        photos: Gives their pictures by position, (3, H, W) uint8.
        rasterizer: What draws.
        priors: Estimated depths by position, for losses that need them.
        masks: Which pixels count, by position, (H, W) bool or None; None if all do.
        expect: Told the positions in the order in which they will be asked for, whenever a new order begins.
        owns: (N, 3) positions to (N,) bool: points elsewhere are neither copied nor split; None if all points may be.
        beside: Gives the positions of the views that may be second ones, best first, from the position of a view and
            the depth that is rendered there; None finds them by the cameras (`NeighbourSelector.neighbours`).
        gpu_bytes: Photographs, masks and priors that may be kept on a GPU.
        home: Where the points are kept; None where the rasterizer draws. Elsewhere, steps must be for the points in
            view alone (`in_view.why_all`).
    """

    stage: Stage
    primitive: Primitive
    views: Sequence[View]
    photos: TrainingPhotos
    rasterizer: Rasterizer
    priors: Sequence[DepthPrior | None] | None = None
    masks: Sequence[Tensor | None] | None = None
    expect: Callable[[Sequence[int]], None] | None = None
    owns: Callable[[Tensor], Tensor] | None = None
    beside: Callable[[int, Tensor], list[int]] | None = None
    gpu_bytes: int = 0
    home: Storage | None = None

    @property
    def processes(self) -> Processes | None:
        """Those that the points are divided over; None where this one has all of them."""
        return self.rasterizer.processes if isinstance(self.rasterizer, DividedRasterizer) else None

    def count(self, points: Points) -> int:
        """Points of all processes, of those of this one."""
        return len(points) if self.processes is None else sum(self.processes.of_each(len(points)))

    @cached_property
    def draws(self) -> Rasterizer:
        """What draws the splats of the primitive."""
        return drawn_by(self.primitive, self.rasterizer)

    @cached_property
    def uploads(self) -> Uploads:
        """The photographs, masks and priors, where the rasterizer draws."""
        return Uploads(self.rasterizer.where(), self.photos, self.masks, self.priors, self.gpu_bytes)

    @cached_property
    def selector(self) -> NeighbourSelector:
        """The cameras of all views."""
        return NeighbourSelector.of([view.camera for view in self.views])

    @cached_property
    def rates(self) -> dict[str, LearningRate]:
        """The learning rate of each parameter."""
        return rates_of(self.stage, self.primitive)
