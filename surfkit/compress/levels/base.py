"""What makes levels of detail."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from surfkit.compress.levels.lod_tree import LodTree
from surfkit.core.registry import Component
from surfkit.primitives.base import Primitive
from surfkit.primitives.model import SplatModel
from surfkit.raster.base import Rasterizer
from surfkit.scene.scene import Frame, View


@dataclass(frozen=True)
class LodInput:
    """What levels of detail are made from.

    Attributes:
        model: The full model, in the local frame.
        views: Training views; there is at least one.
        rasterizer: Draws the splats of the model's primitive.
        frame: Where the local frame lies.
        seed: Of every random draw.
        folder: For files of the component's own, from which an interrupted call goes on. It is there, belongs to these
            inputs and these settings alone, and is deleted when the levels are made.
        budget_bytes: Memory for rendered pictures that are kept.
    """

    model: SplatModel
    views: Sequence[View]
    rasterizer: Rasterizer
    frame: Frame
    seed: int
    folder: Path
    budget_bytes: int = 1 << 28


class LevelsOfDetail(Component):
    """Makes levels of detail of a trained model: blocks of it, and fewer splats that stand for them from afar."""

    def refuse_unfit(self, primitive: Primitive) -> None:  # noqa: B027 (most fit all)
        """BadInput if levels of a model of this primitive cannot be made; asked before anything is trained."""

    @abstractmethod
    def build(self, given: LodInput) -> LodTree:
        """The levels: the first is the full model, each point of it once, in any order; none has more points than the
        one before.

        The blocks without children are all of the first level. The error of a block is not below that of its children,
        and 0 where it has none. Progress is told by `surfkit.core.events.Progress`.

        Raises:
            BadInput: Levels of this model cannot be made.
            KeyboardInterrupt: The run was asked to stop; the next call may go on from what is in `given.folder`.
        """
