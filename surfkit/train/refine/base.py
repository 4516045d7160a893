"""What may be done with a trained model as a whole, once its blocks are merged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from surfkit.core.registry import Component
from surfkit.depth.base import DepthEstimator
from surfkit.mesh.base import Mesher, MeshInput
from surfkit.primitives.base import Primitive
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns
from surfkit.scene.scene import View
from surfkit.train.stage import Stage


@dataclass(frozen=True)
class Refine(Component):
    """One more optimisation of the whole model, from where the one before ended."""

    taught: ClassVar[bool] = False
    """Whether it is shown what the model before it draws, instead of photographs."""

    stage: Stage = field(default_factory=Stage)
    """The optimisation."""

    def refuse_unfit(self, primitive: Primitive) -> None:  # noqa: B027 (most fit all)
        """BadInput if a model of this primitive cannot go through it; asked before anything is trained."""

    def primitive(self, primitive: Primitive) -> Primitive:
        """What the points are from then on, given what they were."""
        return primitive

    def params(self, params: Columns) -> Columns:
        """Raw parameters to begin with, given those of the model before."""
        return params

    def begin(self, before: SplatModel, to_mesh: Callable[[Mesher], MeshInput]) -> Columns:
        """Raw parameters to begin with; by default those that `params` gives.

        Args:
            before: The model before.
            to_mesh: That model and its training views, as one of the `meshers` needs them.

        Raises:
            BadInput: The model cannot be refined so.
        """
        return self.params(before.params)

    @property
    def meshers(self) -> tuple[Mesher, ...]:
        """What it makes meshes with; before anything is trained they are asked whether they can work."""
        return ()

    @property
    def estimator(self) -> DepthEstimator | None:
        """What makes the depth maps that its losses look at, from the depth that the model before draws; None for those
        of the run."""
        return None

    def views(self, views: Sequence[View], seed: int) -> tuple[View, ...]:
        """The cameras to look from, given those of the training photographs: all of them, unless it is taught.

        Those that are drawn by chance are drawn from `seed`, and are the same again.
        """
        return tuple(views)
