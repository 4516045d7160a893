"""How a scene is cut: cells on the ground that own every point exactly once."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect
from surfkit.core.registry import Component
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.observations import Observations
from surfkit.scene.scene import Frame, View

MIN_ALIGNED_COSINE = math.cos(math.radians(25))
"""A ground this close to two axes of the frame is taken to lie along them."""

Box = tuple[float | None, float | None, float | None, float | None]
"""Lower x and y, upper x and y of a cell, half open; None where it has no end."""


@dataclass(frozen=True)
class Ground:
    """The plane on which a scene is cut.

    Attributes:
        x: Its first axis, a unit vector of the local frame.
        y: The second.
    """

    x: tuple[float, float, float]
    y: tuple[float, float, float]

    def __post_init__(self) -> None:
        apart = torch.tensor([self.x, self.y], dtype=torch.float64)
        expect("ground", apart, (2, 3))
        if not torch.allclose(apart @ apart.T, torch.eye(2, dtype=torch.float64), atol=1e-4):
            raise BadInput(f"ground: axes {self.x} and {self.y}; they must have length 1 and be perpendicular")

    @classmethod
    def under(cls, centres: Tensor, points: Tensor) -> Ground:
        """The plane along which cameras, (V, 3), spread the most, or points, (N, 3), where cameras tell less.

        That is where they stand in a line, or where a kite or a walk has taken them up and down, and the points lie
        twice as flat. If it is nearly a plane of two axes of the frame, as in a georeferenced scene, it is that one.
        """
        spread, axes = _axes(centres)
        depth, others = _axes(_without_far(points))
        in_line = len(centres) < 3 or spread[1] < 0.05 * spread[2]
        up_and_down = spread[0] > 0.1 * spread[1] and 2 * depth[0] * spread[1] < spread[0] * depth[1]
        if in_line or up_and_down:
            axes = others
        up = axes[:, 0]
        if float(up.abs().max()) >= MIN_ALIGNED_COSINE:
            flat = [axis for axis in range(3) if axis != int(up.abs().argmax())]
            axes = torch.eye(3, dtype=torch.float64)[:, flat]
        else:
            axes = axes[:, [2, 1]]
        first, second = (tuple(axis.tolist()) for axis in axes.T)
        return cls(first, second)

    @property
    def axes(self) -> Tensor:
        """(3, 3) float64 unit vectors in rows: both axes of the plane, and the one that stands on it, up or down."""
        plane = torch.tensor([self.x, self.y], dtype=torch.float64)
        return torch.cat([plane, torch.linalg.cross(plane[0], plane[1])[None]])

    def flat(self, points: Tensor) -> Tensor:
        """(N, 2) float64 places on the ground of (N, 3) points."""
        return points.double() @ torch.tensor([self.x, self.y], dtype=torch.float64).T


def _without_far(points: Tensor) -> Tensor:
    """(M, 3) the points without the twentieth that is farthest from their middle."""
    distance = (points - points.median(0).values).norm(dim=1)
    return points[distance <= distance.sort().values[int(0.95 * (len(points) - 1))]]


def _axes(points: Tensor) -> tuple[Tensor, Tensor]:
    """(3,) standard deviations and (3, 3) principal axes in columns, the smallest first."""
    centred = points.double() - points.double().mean(0)
    values, vectors = torch.linalg.eigh(centred.T @ centred / max(1, len(points)))
    return values.clamp_min(0).sqrt(), vectors


@dataclass(frozen=True)
class Contraction:
    """Unbounded ground in the unit square, a foreground box in its middle (CityGaussian; Mip-NeRF 360).

    Attributes:
        low: Lower corner of the foreground on the ground; it becomes (1/4, 1/4).
        high: Upper corner; it becomes (3/4, 3/4).
    """

    low: tuple[float, float]
    high: tuple[float, float]

    def contracted(self, flat: Tensor) -> Tensor:
        """(N, 2) places in the unit square of (N, 2) places on the ground."""
        low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (self.low, self.high))
        at = (flat - (low + high) / 2) / ((high - low) / 2)
        size = at.abs().amax(1, keepdim=True)
        far = (2 - 1 / size.clamp_min(1)) * at / size.clamp_min(1)
        return torch.where(size > 1, far, at) / 4 + 0.5


@dataclass(frozen=True)
class Cells:
    """Cells that tile the ground: every place is in exactly one, the outer ones reach to infinity.

    Attributes:
        ground: What they lie on.
        boxes: Of each cell, on the ground or in the unit square of the contraction.
        blocks: The block that each cell belongs to, counted from 0.
        contraction: Applied before boxes are looked up.
    """

    ground: Ground
    boxes: tuple[Box, ...]
    blocks: tuple[int, ...]
    contraction: Contraction | None = None

    def __post_init__(self) -> None:
        if len(self.boxes) != len(self.blocks) or sorted(set(self.blocks)) != list(range(len(set(self.blocks)))):
            raise BadInput(f"cells: {len(self.boxes)} boxes of blocks {self.blocks}; each needs one, counted from 0")
        if not self.boxes:
            raise BadInput("cells: there are none")

    def refuse_untiled(self, where: str) -> None:
        """BadInput unless every place is in exactly one cell: one in two would belong to the block of the last.

        Args:
            where: Begins messages.
        """
        if not all(type(block) is int for block in self.blocks):
            raise BadInput(f"{where}: blocks are {self.blocks}; give whole numbers, counted from 0")
        for at, box in enumerate(self.boxes):
            ends = [end is None or (isinstance(end, (int, float)) and abs(end) < math.inf) for end in box]
            if len(ends) != 4 or not all(ends):
                raise BadInput(f"{where}: box {at} is {box}; give lower x and y, upper x and y, numbers or None")
            sides = ((box[0], box[2]), (box[1], box[3]))
            if any(low is not None and high is not None and low >= high for low, high in sides):
                raise BadInput(f"{where}: box {at} is {box}; its upper x and y must be above its lower ones")
        across, along, _ = self._fields
        times = torch.zeros(len(across) + 1, len(along) + 1)
        for part in self._parts():
            times[part] += 1
        if not bool((times == 1).all()):
            found = "in none of the cells" if bool((times < 1).any()) else "in several cells"
            raise BadInput(f"{where}: some place on the ground is {found}; each must be in exactly one, far away too")

    @property
    def count(self) -> int:
        """Blocks."""
        return max(self.blocks) + 1

    def flat(self, points: Tensor) -> Tensor:
        """(N, 2) float64 places of (N, 3) points, where the boxes lie: on the ground, or in the unit square."""
        flat = self.ground.flat(points)
        return flat if self.contraction is None else self.contraction.contracted(flat)

    def owner(self, points: Tensor) -> Tensor:
        """(N,) int64, the block that owns each of (N, 3) points; -1 for one that is not finite."""
        flat, (x, y, blocks) = self.flat(points), self._fields
        at = (torch.bucketize(flat[:, axis].contiguous(), side, right=True) for axis, side in enumerate((x, y)))
        return blocks[tuple(at)].masked_fill_(~flat.isfinite().all(1), -1)

    @cached_property
    def _fields(self) -> tuple[Tensor, Tensor, Tensor]:
        """(X,) and (Y,) all borders along each axis, and (X + 1, Y + 1) the block that owns each field between them.

        A place is found among the borders of each axis: with as many steps as a cell has there, however many cells.
        """
        borders = self._borders()
        blocks = torch.full((len(borders[0]) + 1, len(borders[1]) + 1), -1)
        for part, block in zip(self._parts(), self.blocks, strict=True):
            blocks[part] = block
        across, along = (torch.tensor(some, dtype=torch.float64) for some in borders)
        return across, along, blocks

    def _borders(self) -> tuple[list[float], list[float]]:
        """All borders along each axis, in order."""
        x, y = ({end for box in self.boxes for end in (box[axis], box[axis + 2]) if end is not None} for axis in (0, 1))
        return sorted(x), sorted(y)

    def _parts(self) -> Iterator[tuple[slice, slice]]:
        """The fields between the borders that each box is made of."""
        rows: list[dict[float | None, int]] = [{end: at + 1 for at, end in enumerate(s)} for s in self._borders()]
        x, y = rows
        for x0, y0, x1, y1 in self.boxes:
            yield slice(x.get(x0, 0), x.get(x1)), slice(y.get(y0, 0), y.get(y1))


@dataclass(frozen=True)
class CoarseModel:
    """A coarse model and the views it was trained on.

    Attributes:
        splats: Activated values, local frame.
        views: Training views.
        rasterizer: Draws the splats.
        near: Local units.
        frame: Where the local frame lies, for lengths in metres.
        observations: The sparse points that each view shows; none unless the assignment needs them.
        seed: Of random draws.
    """

    splats: Splats
    views: Sequence[View]
    rasterizer: Rasterizer
    near: float
    frame: Frame = field(default_factory=lambda: Frame(np.zeros(3), 1.0))
    observations: Observations | None = None
    seed: int = 0

    @property
    def centres(self) -> Tensor:
        """(V, 3) float64 positions of the cameras."""
        return torch.stack([view.camera.centre for view in self.views])

    @property
    def pixels(self) -> Tensor:
        """(V,) float64 sizes of the photographs."""
        return torch.tensor([view.camera.width * view.camera.height for view in self.views], dtype=torch.float64)

    def share(self, at: int) -> Tensor:
        """(N,) the part of the picture of a view that each splat makes up: the mean over its pixels of alpha T."""
        total, _ = self.rasterizer.contribution(self.splats, self.views[at].camera, self.near, 1.0, 1.0)
        return total / float(self.pixels[at])


class Partition(Component):
    """A way to cut a scene into blocks."""

    def refuse_unfit(self, frame: Frame) -> None:
        """Check, before hours are spent, whether its settings suit the data set.

        Raises:
            BadInput: A length is in metres, and the data set does not say how long its unit is.
        """

    @abstractmethod
    def cells(self, sight: CoarseModel) -> Cells:
        """The cells; they depend on nothing but the model and the cameras.

        Raises:
            BadInput: The scene cannot be cut so.
        """
