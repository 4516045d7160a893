"""`surfkit train`."""

from __future__ import annotations

import re
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import surfkit
from surfkit.blocks.schedule import Compute
from surfkit.cli.recipes import ARGV, chosen_recipe, settled
from surfkit.cli.result import show
from surfkit.core.check import BadInput
from surfkit.core.registry import choice
from surfkit.execute.base import Executor, Inline
from surfkit.pipeline import run, with_steps
from surfkit.raster.select import Device
from surfkit.readers.data import Reading
from surfkit.recipe import Recipe, unused
from surfkit.report.tensorboard import tensorboard
from surfkit.run.folder import Run
from surfkit.run.stage import CHECKPOINT_EVERY, Intervals
from surfkit.train.material import CacheSettings

EXAMPLE = Path(surfkit.__file__).parents[1] / "examples" / "boruszyn"

BLOCKS_ONLY = re.compile(r"--(tune\.|assign\.|min-views|context)|(tune\.|assign:)")
"""Words that say something of blocks alone."""


def named_recipe() -> str:
    """The recipe's name as typed, for the default run folder."""
    typed = [word.removeprefix("recipe:") for word in ARGV.get() if word.startswith("recipe:")]
    return Path(typed[-1]).stem if typed else "run"


@dataclass(frozen=True)
class Train:
    """Reconstruct a surface from photographs with known cameras.

    An interrupted run goes on when the same command is given again, and a finished one when --steps is raised. Any part
    of the recipe can be swapped with `field:NAME`, such as `primitive:gaussian3d` or `pretrain.densify:none`; `surfkit
    components` lists the names. Exits 1 when memory, disk or finite numbers give out, 2 for words and data to put
    right, 130 when interrupted.
    """

    recipe: Annotated[Recipe, chosen_recipe]
    """What to do."""

    data: Path | None = None
    """Data set: images/ and a COLMAP model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, or another
    layout. By default the bundled example, a farm photographed from a kite."""

    out: Path | None = None
    """Run folder; runs/DATA-RECIPE by default."""

    steps: int | None = None
    """Length of the run. Every schedule of the recipe is scaled along, so that a short run is a small whole run. Raised
    later, the run goes on under the schedules of the new length."""

    reading: Annotated[Reading, tyro.conf.arg(name="")] = Reading()
    """How the data set is read."""

    device: Device = "auto"
    """Where to compute."""

    executor: Annotated[Executor, choice(Executor)] = Inline()
    """Who tunes the blocks, where the recipe cuts the scene into some; `executor:pool` takes several at a time,
    `executor:ray` and `executor:slurm` those of other machines."""

    checkpoint_every: int = CHECKPOINT_EVERY
    """Steps between checkpoints, of which the last two are kept; there is also one at an interruption."""

    pictures_every: int | None = None
    """Steps between pictures of up to three held-out photographs, in progress/ of the run folder; a fifth of the run by
    default, 0 for none."""

    tensorboard: bool = False
    """Also write losses, points, memory and held-out PSNR for TensorBoard, to tensorboard/ in the run folder;
    every block and every refinement has a folder of its own there."""

    cache: str = "auto"
    """Memory for photographs, masks and depth priors, such as 4GB or 500MB; auto takes half of what is free. The result
    does not depend on it. When memory gives out, it is lowered by itself."""

    resized_copies: bool = False
    """Keep photographs that do not fit into the cache on disk too, decoded and reduced, in DATA/resized: worth its
    space when large photographs are used much smaller. The result does not depend on it."""

    prepare: bool = True
    """Make depth maps by itself where the recipe wants some and the data set has none, once: they are kept in
    $SURFKIT_CACHE, or ~/.cache/surfkit."""

    prepare_cache: str = "20GB"
    """Disk for such depth maps, of all data sets together; those longest unused are deleted when there are more."""

    folder: tyro.conf.Suppress[str] = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "recipe", settled(self.recipe))
        if self.pictures_every and not self.recipe.has_stages:
            raise BadInput(unused(self.recipe, f"--pictures-every {self.pictures_every}"))
        if self.checkpoint_every < 1:
            raise BadInput(f"--checkpoint-every {self.checkpoint_every}: give 1 or more steps")
        if self.pictures_every is not None and self.pictures_every < 0:
            raise BadInput(f"--pictures-every {self.pictures_every}: give 0 (none) or more steps")
        if self.recipe.partition is None and (idle := [word for word in ARGV.get() if BLOCKS_ONLY.match(word)]):
            raise BadInput(
                f"{idle[0]}: the recipe cuts the scene into no blocks, so this has nothing to do; add "
                "partition:contracted-grid, or leave it out"
            )
        if not self.folder:  # the words of the command line are only known while it is parsed
            object.__setattr__(self, "folder", named_recipe())

    def run(self) -> None:
        """Train, and show what came out."""
        data = self.reading.of(self._data())
        out = self.out or Path("runs") / f"{data.path.resolve().name}-{self.folder}"
        recipe = self.recipe if self.steps is None else with_steps(self.recipe, self.steps)
        with tensorboard(out) if self.tensorboard else nullcontext():
            intervals = Intervals(self.checkpoint_every, self.pictures_every)
            caches = CacheSettings(self.cache, self.resized_copies, self.prepare_cache if self.prepare else None)
            metrics = run(recipe, data, out, Compute(self.device, self.executor, self.tensorboard), intervals, caches)
        show(Run(out, recipe, data), metrics)

    def _data(self) -> Path:
        if self.data is not None:
            return self.data
        if not EXAMPLE.is_dir():
            raise BadInput(
                "no --data given, and the bundled example is only part of a source checkout; name a data set"
            )
        print(f"no --data given: using the bundled example {EXAMPLE}", file=sys.stderr)
        return EXAMPLE


COMMAND = Train
