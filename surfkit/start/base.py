"""The initial points of a run."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect_kind, expect_tensor
from surfkit.core.registry import Component, class_path
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns
from surfkit.scene.scene import Scene, SparsePoints


@dataclass(frozen=True)
class StartInput:
    """What is known before the first optimisation step.

    Attributes:
        scene: Its training views, cameras and sparse points.
        photos: (3, H, W) uint8 by position of the training view.
        masks: (H, W) bool by position, False where the photograph is to be ignored; None where there is no mask.
        priors: By position, with normals if the data set has them; None where the start needs no priors.
        generator: Of every random draw.
    """

    scene: Scene
    photos: Sequence[Tensor]
    masks: Sequence[Tensor | None] | None
    priors: Sequence[DepthPrior | None] | None
    generator: torch.Generator


@dataclass(frozen=True)
class InitialModel:
    """The points that a stage begins with.

    Attributes:
        params: Their raw parameters, and the shared ones, as `Primitive.init` gives them.
        sh_degree: Of the spherical harmonics that they have learnt so far.
        stats: What is kept with the points and not optimised, each (N, ...).
    """

    params: Columns
    sh_degree: int = 0
    stats: Columns = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sh_degree not in range(4):
            raise BadInput(f"the points begin with sh_degree {self.sh_degree}; it must be 0, 1, 2 or 3")


def _refuse_unsound(where: str, cloud: Any) -> None:
    """BadInput unless it is points with colours; those in [0, 1] would begin as black, and be learnt slowly."""
    expect_kind(where, cloud, SparsePoints)
    sizes = expect_tensor(f"{where}: xyz", cloud.xyz, ("float32", "float64"), ("P", 3))
    expect_tensor(f"{where}: rgb", cloud.rgb, ("uint8",), ("P", 3), sizes)
    for name, shape in (("normals", ("P", 3)), ("opacity", ("P",)), ("size", ("P",))):
        if (value := getattr(cloud, name)) is not None:
            expect_tensor(f"{where}: {name}", value, ("float32", "float64"), shape, sizes)
    if not bool(cloud.xyz.isfinite().all()):
        raise BadInput(f"{where}: xyz: {int((~cloud.xyz.isfinite()).any(1).sum())} of {len(cloud.xyz)} are not finite")


class Start(Component):
    """A way to find the points that the optimisation starts from."""

    @property
    def is_dense(self) -> bool:
        """Whether points lie on most of the surface from the start, so that densification adds few; for a forecast."""
        return False

    def usual_steps(self, photographs: int, on_gpu: bool) -> int | None:
        """Optimisation steps after which a run that begins so gains little; None: as many as the recipe says.

        Args:
            photographs: To train on.
            on_gpu: Whether steps are cheap.
        """
        return None

    @property
    def needs_prior(self) -> bool:
        """Whether it looks at depth priors. Only then are they read and, where the data set has none, made."""
        return False

    @property
    def most_points(self) -> int | None:
        """How many points it gives at most, however large the scene is; None for any number. For a forecast."""
        return None

    def limited(self, points: int) -> Start:
        """The same start, limited to a number of points where it has a setting for that; for comparisons."""
        return self

    def files(self) -> tuple[Path, ...]:
        """Files that it reads beside the data set: a run that has begun is refused with one that has changed."""
        return ()

    def refuse_unfit(self, primitive: Primitive, scene: Scene) -> None:  # noqa: B027 (most fit all)
        """BadInput if the run cannot begin so; asked before anything is written, of a run that is still to begin."""

    def model(self, primitive: Primitive, known: StartInput, generator: torch.Generator) -> InitialModel:
        """The points as raw parameters of the primitive; by default those that it begins with at `cloud`.

        Args:
            primitive: What the points are to be.
            known: As for `cloud`.
            generator: Of every random draw of the primitive.

        Raises:
            BadInput: There is nothing to start from.
        """
        cloud = self.cloud(known)
        _refuse_unsound(f"{class_path(type(self))}.cloud", cloud)
        return InitialModel(primitive.init(cloud, generator))

    @abstractmethod
    def cloud(self, known: StartInput) -> SparsePoints:
        """The points, the same for the same settings, data and state of the generator.

        Raises:
            BadInput: There is nothing to start from.
        """

    @abstractmethod
    def expected(self, sparse: int, pixels: int) -> int:
        """About how many points there will be, for a forecast.

        Args:
            sparse: Sparse points of the scene.
            pixels: Of all training photographs together, at the size they are used at.
        """
