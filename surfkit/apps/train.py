"""`surfkit train`."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import surfkit
from surfkit.apps.doctor.default_steps import with_usual_steps
from surfkit.apps.prepare_photos import as_before
from surfkit.apps.run_summary import show, what_next
from surfkit.apps.view.server import LOCAL, Address, refuse_wrong_port
from surfkit.cli.console_table import tell
from surfkit.cli.recipes import ARGV, chosen_recipe, settled
from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.core.registry import choice
from surfkit.io.datasets.data import ReadSettings
from surfkit.io.datasets.read import bare_photographs
from surfkit.raster.select import Device
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.execute.base import Executor, Inline
from surfkit.runs.folder import Run, read_data
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe, unused, with_steps
from surfkit.runs.run_stage import CHECKPOINT_EVERY, Intervals
from surfkit.study.tensorboard import tensorboard
from surfkit.train.data_cache import CacheSettings
from surfkit.train.points_on import Place, PointsOn

EXAMPLE = Path(surfkit.__file__).parents[1] / "examples" / "boruszyn"

BLOCKS_ONLY = re.compile(r"--(tune\.|assign\.|min-views|context)|(tune\.|assign:)")
"""Arguments that apply to blocks only."""
VIEW_ONLY = re.compile(r"--view[-_](host|port|share)")
"""Arguments that apply to the page only."""


def named_recipe() -> str:
    """The recipe's name as typed, for the default run folder."""
    typed = [word.removeprefix("recipe:") for word in ARGV.get() if word.startswith("recipe:")]
    return Path(typed[-1]).stem if typed else "run"


@dataclass(frozen=True)
class TrainCommand:
    """Train a model, and make its mesh, from photographs with known cameras.

    An interrupted run continues when the same command is given again, and a finished run when --steps is raised. Any
    component of the recipe can be replaced with `field:NAME`, such as `primitive:gaussian3d` or
    `pretrain.densify:none`; `surfkit components` lists the names. Exit status: 1 when the run is out of memory or disk
    or on NaN or Inf, 2 for wrong arguments or data, 130 when interrupted.
    """

    recipe: Annotated[Recipe, chosen_recipe]
    """What is trained and how: all settings, and the components."""

    data: Path | None = None
    """Data set: images/ and a COLMAP model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, or another
    layout. Default: the bundled example, a farm photographed from a kite."""

    out: Path | None = None
    """Run folder. Default: runs/DATA-RECIPE."""

    steps: int | None = None
    """Optimisation steps. Every schedule of the recipe is scaled by the same factor, so that a short run goes through
    all phases. When this is raised later, the run continues with the schedules of the new length. Default: those of the
    recipe; for recipe:surface and others that begin at stereo depth, 30 for each photograph, 120 on a GPU."""

    reading: Annotated[ReadSettings, tyro.conf.arg(name="")] = ReadSettings()
    """How the data set is read."""

    device: Device = "auto"
    """Device for training and rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    executor: Annotated[Executor, choice(Executor)] = Inline()
    """Where the blocks are trained, if the recipe divides the scene into blocks: `executor:pool` trains several at the
    same time on this machine, `executor:ray` and `executor:slurm` use other machines."""

    processes: int = 1
    """Processes on this machine that train the model together: each has a part of the points and draws a strip of each
    picture. One needs about 1/processes of the memory for points. For recipes without blocks, on the CPU; the cores are
    divided among them. Sums are rounded in another order, and so results differ in their last digits."""

    checkpoint_every: int = CHECKPOINT_EVERY
    """Steps between checkpoints. The last two are kept; an interruption writes one, too."""

    pictures_every: int | None = None
    """Steps between renders of up to three held-out photographs, written to progress/ in the run folder. Default: a
    fifth of the run; 0 for none."""

    tensorboard: bool = False
    """Also write losses, points, memory and held-out PSNR for TensorBoard, to tensorboard/ in the run folder, with one
    subfolder for each block and each refinement."""

    view: bool = False
    """Serve a page on this machine while the run goes on: a live picture, losses and PSNR, and a button that pauses.
    Its address, which is printed, ends in a random token. Needs `pip install 'surfkit[view]'`."""

    view_host: str = LOCAL
    """Address to serve the page at. 0.0.0.0 lets other machines connect, if they have the token; nothing is
    encrypted."""

    view_port: int | None = None
    """Port to serve the page at. Default: the first free one from 8080 on."""

    view_share: float = 0.3
    """Share of the time that live pictures may take, above 0 and at most 1. They are drawn between two steps, and only
    while a browser shows the page. They do not change the result."""

    cache: str = "auto"
    """Memory for photographs, masks and depth priors, such as 4GB or 500MB; auto is half of the free memory. It does
    not change the result. When the run is out of memory, it is lowered automatically."""

    gpu_cache: str = "auto"
    """Memory of the GPU for them, where there is one; auto is a quarter of what is free on it. It does not change the
    result. When the GPU is out of memory, nothing is kept there any more."""

    points_on: Place = "auto"
    """Where points are kept, with the moments of the optimiser: where they are drawn (device), in the memory of the CPU
    (host), or in files on the disk (disk), of which the memory holds what views show. host and disk need stages that
    update only points in view (`pretrain.optimizer:adam-in-view`). auto is device; when its memory is full, host, and
    when that is full, disk, if the stage allows it."""

    scratch: Path | None = None
    """Folder for the files of points, best on a fast disk of this machine. Default: the run folder."""

    resized_copies: bool = False
    """Also keep photographs that do not fit into the cache on disk, decoded and resized, in DATA/resized. It saves time
    when large photographs are used at a much smaller size. It does not change the result."""

    prepare: tyro.conf.FlagCreatePairsOff[bool] = False
    """If --data is a folder of photographs without cameras, find their cameras first, as `surfkit prepare photos` does,
    and train on the data set that this writes beside the folder."""

    no_prepare: tyro.conf.FlagCreatePairsOff[bool] = False
    """Estimate no depth maps. Otherwise they are estimated if the recipe uses them and the data set has none, and kept
    in $SURFKIT_CACHE, or ~/.cache/surfkit, for later runs."""

    prepare_cache: str = "20GB"
    """Disk space for these depth maps, of all data sets together; when they take more, the least recently used are
    deleted."""

    folder: tyro.conf.Suppress[str] = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "recipe", settled(self.recipe))
        if self.pictures_every and not self.recipe.has_stages:
            raise BadInput(unused(self.recipe, f"--pictures-every {self.pictures_every}"))
        if self.prepare and self.no_prepare:
            raise BadInput("--prepare makes what is missing, and --no-prepare makes no depth maps; give one")
        if self.checkpoint_every < 1:
            raise BadInput(f"--checkpoint-every {self.checkpoint_every}: give 1 or more steps")
        if self.pictures_every is not None and self.pictures_every < 0:
            raise BadInput(f"--pictures-every {self.pictures_every}: give 0 (none) or more steps")
        if self.processes < 1:
            raise BadInput(f"--processes {self.processes}: give 1 or more")
        if self.view and self.processes > 1:
            raise BadInput(f"--view shows what one process draws; leave it out, or --processes {self.processes}")
        self._refuse_wrong_view()
        if self.recipe.partition is None and (idle := [word for word in ARGV.get() if BLOCKS_ONLY.match(word)]):
            raise BadInput(
                f"{idle[0]}: the recipe does not divide the scene into blocks, so this has no effect; add "
                "partition:contracted-grid, or leave it out"
            )
        if not self.folder:  # the words of the command line are only known while it is parsed
            object.__setattr__(self, "folder", named_recipe())

    def _refuse_wrong_view(self) -> None:
        refuse_wrong_port(self.view_port, "--view-port")
        if not 0 < self.view_share <= 1:
            raise BadInput(f"--view-share {self.view_share:g}: give a share above 0, and at most 1")
        if not self.view and (idle := [word for word in ARGV.get() if VIEW_ONLY.match(word)]):
            raise BadInput(f"{idle[0]}: there is no page without --view, so this has no effect; add --view")

    def run(self) -> None:
        """Train, and print the results."""
        if not self.view:
            self._train()
            return
        from surfkit.apps.view.live import live_view  # half a second of imports

        address = Address(self.view_host, self.view_port, "--view-")
        with live_view(address, self.view_share) as live:
            say(f"--view: the run is shown at {live.url}")
            if not address.is_local:
                say("--view: whoever has this address can look and pause; what is sent is not encrypted")
            try:
                self._train(live.following)
            finally:
                say("--view: the page ends with the run")

    def _train(self, following: Callable[[Path], AbstractContextManager[object]] = nullcontext) -> None:
        path = self._with_cameras(self._data())
        out = self.out or Path("runs") / f"{path.resolve().name}-{self.folder}"
        data = self.reading.of(path, self._test_every(out))
        if self.steps is None:
            recipe = with_usual_steps(self.recipe, data, self.device, out)
        else:
            recipe = with_steps(self.recipe, self.steps)
        with following(out), tensorboard(out) if self.tensorboard else nullcontext():
            intervals = Intervals(self.checkpoint_every, self.pictures_every)
            maps, points = None if self.no_prepare else self.prepare_cache, PointsOn(self.points_on, self.scratch)
            caches = CacheSettings(self.cache, self.resized_copies, maps, self.gpu_cache, points)
            metrics = run(
                recipe,
                data,
                out,
                Compute(self.device, self.executor, self.tensorboard, self.processes),
                intervals,
                caches,
            )
        show(Run(out, recipe, data), metrics)
        print()
        tell(what_next(Run(out, recipe, data)))

    def _test_every(self, out: Path) -> int:
        """Which photographs are held out where nobody says: those that the run in a folder has begun without, or as the
        recipe has it. Older versions held out every 8th with all recipes."""
        return read_data(out).test_every if (out / "run.json").exists() else self.recipe.test_every

    def _with_cameras(self, data: Path) -> Path:
        """The data set; with --prepare, that of a folder of photographs, made now or taken up where it was left."""
        photos = bare_photographs(data) if self.prepare and self.reading.layout is None else None
        if photos is None:
            return data
        if self.reading.images is not None:
            raise BadInput(f"--images {self.reading.images} with --prepare: name the folder of photographs with --data")
        preparation = as_before(photos, self.device)
        preparation.prepare()
        return preparation.scene

    def _data(self) -> Path:
        if self.data is not None:
            return self.data
        if not EXAMPLE.is_dir():
            raise BadInput(
                "no --data given, and the bundled example is only part of a source checkout; name a data set"
            )
        say(
            f"no --data given, so this trains on the bundled example {EXAMPLE}; --data FOLDER names a data set of yours"
        )
        return EXAMPLE


COMMAND = TrainCommand
