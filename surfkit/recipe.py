"""What a run is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from surfkit.core.check import BadInput
from surfkit.core.registry import choice
from surfkit.depth.base import DepthEstimator
from surfkit.mesh.base import Mesher
from surfkit.partition.assign import Assign, SSIMDifference
from surfkit.partition.base import Partition
from surfkit.primitives.base import Primitive
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.refine.base import Refine
from surfkit.start.base import Start
from surfkit.start.plain import SparseStart
from surfkit.train.stage import Stage

Context = Literal["densified", "tuned", "frozen"]
"""What becomes of the points around a block while it is tuned."""


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a result, and nothing that does not."""

    about: Annotated[str, tyro.conf.Suppress] = ""
    """What the recipe is, in one line."""

    primitive: Annotated[Primitive, choice(Primitive)] = Surfel2D()
    """What the scene is made of."""

    depth: Annotated[DepthEstimator | None, choice(DepthEstimator, optional=True)] = None
    """How depth maps are made for recipes that need priors where the data set has none; none makes none."""

    start: Annotated[Start, choice(Start)] = SparseStart()
    """Where the points of pretraining begin."""

    pretrain: Stage = field(default_factory=Stage)
    """Optimisation of the whole scene."""

    partition: Annotated[Partition | None, choice(Partition, optional=True)] = None
    """How the scene is cut into blocks that are tuned apart, after pretraining; none leaves it whole."""

    assign: Annotated[Assign, choice(Assign)] = SSIMDifference()
    """Which views a block is tuned on, where the scene is cut."""

    min_views: Annotated[int, tyro.conf.arg(name="min-views")] = 50
    """A block with fewer views is joined to a neighbour; in a small scene a quarter of an even share is enough."""

    tune: Stage = field(default_factory=Stage)
    """Optimisation of each block, where the scene is cut."""

    context: Context = "densified"
    """Points around a block that its views show: densified like its own; tuned, but neither cloned nor split; or
    frozen, drawn as they are in the coarse model. None of them is merged. Whose a point is, its position tells at each
    edit."""

    refine: tuple[Annotated[Refine, choice(Refine)], ...] = ()
    """What the whole model goes through when it is trained, and its blocks merged if there are any; refine.0:NAME adds
    the first, refine.1:NAME the next, refine.0:none drops one."""

    mesh: Annotated[Mesher | None, choice(Mesher, optional=True)] = None
    """How the splats become triangles when they are trained; none for splats alone."""

    seed: int = 0
    """Of every random draw."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**63:
            raise BadInput(f"seed is {self.seed}; it must be 0 or more and below 2^63")
        if self.min_views < 1:
            raise BadInput(f"min_views is {self.min_views}; a block needs 1 or more")
        for at, refine in enumerate(self.refine):
            blind = [name for name, loss in refine.stage.losses.items() if refine.taught and loss.needs_prior]
            if blind:
                raise BadInput(f"refine.{at}: learns from what the model draws, where {blind[0]} finds no depth priors")
