"""What a mesher is: splats, the views that saw them, and a way to draw them, to triangles."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from surfkit.core.registry import Component
from surfkit.raster.api import Maps, Rasterizer, Splats
from surfkit.readers.depth_prior import DepthPrior
from surfkit.scene.scene import Frame, View


@dataclass(frozen=True)
class Mesh:
    """Triangles in the local frame.

    Attributes:
        vertices: (V, 3) float32 local positions.
        faces: (F, 3) int32 rows of `vertices`, counter-clockwise seen from outside.
        colors: (V, 3) uint8, or None.
        facts: How it was made, for mesh.json: what automatic settings became, how many tiles there were. Plain values.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class MeshInput:
    """What is to be meshed.

    Attributes:
        splats: Activated values, local frame.
        views: Training views, with cameras in the local frame.
        draw: Maps of a view, geometry included: color, alpha, depth, median, normal.
        rasterizer: For what `draw` does not give.
        near: Local units, of the stage that trained the splats.
        frame: From the local frame back to the input's; knows metres if the data set does.
        budget_bytes: Memory to stay within; work is split into tiles when it would be exceeded.
        generator: Of every random draw.
        scratch: Folder for large temporary files, which the mesher deletes; None for the system's own.
        keep: (H, W) bool mask of a view by its position, or None for all of it; false where nothing is to be fused.
        priors: Estimated depths by position, if the mesher needs them and the data set has any.
        photo: (3, H, W) uint8 photograph of a view by its position, at the size of its camera; None where none are.
    """

    splats: Splats
    views: Sequence[View]
    draw: Callable[[View], Maps]
    rasterizer: Rasterizer
    near: float
    frame: Frame
    budget_bytes: int
    generator: torch.Generator = field(default_factory=torch.Generator)
    scratch: Path | None = None
    keep: Callable[[int], Tensor | None] = lambda at: None
    priors: Sequence[DepthPrior | None] | None = None
    photo: Callable[[int], Tensor] | None = None


class Mesher(Component):
    """A way to turn splats into triangles. Progress is told by `surfkit.core.events.Progress`.

    Depth priors are only made for a run whose data set has none, and read, when it has `needs_prior`.
    """

    def ready(self) -> None:
        """Look, before hours are spent, whether it can work.

        Raises:
            BadInput: A package that it is made with cannot be loaded on this machine.
        """

    needs_prior: ClassVar[bool] = False
    """Whether the mesher looks at depth priors, where there are any; settings of some decide."""

    @abstractmethod
    def mesh(self, subject: MeshInput) -> Mesh:
        """The surface.

        Raises:
            BadInput: There is nothing to mesh, such as no depth in any view.
        """
