"""`surfkit train-block`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surfkit.core.check import BadInput
from surfkit.io.datasets import extract
from surfkit.raster.select import Device
from surfkit.runs.blocks.block import BlockRun, plan_file, read_plan
from surfkit.runs.blocks.worker import train_block
from surfkit.runs.command import train_command
from surfkit.runs.context import RunContext
from surfkit.runs.pipeline import opened
from surfkit.runs.run_notes import collect_notes
from surfkit.runs.run_stage import CHECKPOINT_EVERY, Intervals, select_rasterizer
from surfkit.study.tensorboard import tensorboard
from surfkit.train.data_cache import CacheSettings
from surfkit.train.faults import in_one_line
from surfkit.train.points_on import Place, PointsOn
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class TrainBlockCommand:
    """Train one block of a run to its end, from its last checkpoint.

    For all blocks, `surfkit train` does this. Use this command to divide the blocks between machines that share the run
    folder; then give the `surfkit train` command again to merge the blocks.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run folder whose coarse model is finished and whose blocks are planned."""

    block: Annotated[int, tyro.conf.Positional, tyro.conf.arg(metavar="BLOCK")]
    """Number of the block, counted from 0."""

    device: Device = "auto"
    """Device for training and rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    cache: str = "auto"
    """Memory for photographs, masks and depth priors, such as 4GB; auto is half of the free memory."""

    gpu_cache: str = "auto"
    """Memory of the GPU for them; auto is a quarter of what is free on it."""

    points_on: Place = "auto"
    """Where points are kept, as for `surfkit train`: device, host or disk; auto is the first that has room."""

    scratch: Path | None = None
    """Folder for the files of points. Default: the folder of the block."""

    resized_copies: bool = False
    """Also keep photographs that do not fit into the cache on disk, at the size at which they are used."""

    checkpoint_every: int = CHECKPOINT_EVERY
    """Steps between checkpoints."""

    patience: float = 0.0
    """Seconds to wait while another process trains the block, before this one stops with an error."""

    tensorboard: bool = False
    """Also write losses, points and memory for TensorBoard, to tensorboard/block-NNN in the run folder."""

    def run(self) -> int:
        """Train the block; the exit status is that of `surfkit train`."""
        run = opened(self.run_folder)
        record = read_plan(run)
        plan, steps = record.plan, run.recipe.pretrain.steps
        if record.coarse_steps != steps:
            what = f"{plan_file(run)} is for a coarse model of {record.coarse_steps} steps, not {steps}"
            raise BadInput(f"{what}; `{train_command(run)}` plans the blocks again")
        if not 0 <= self.block < len(plan.blocks):
            raise BadInput(f"{self.run_folder} has blocks 0 to {len(plan.blocks) - 1}; {self.block} is none of them")
        if not plan.blocks[self.block].views:
            raise BadInput(f"block {self.block} has no views; it stays as it is in the coarse model")
        points = PointsOn(self.points_on, self.scratch)
        caches = CacheSettings(self.cache, self.resized_copies, gpu=self.gpu_cache, points=points)
        caches.bytes()
        points.refuse_unfit([("tune", run.recipe.tune, run.recipe.primitive)])
        intervals = Intervals(self.checkpoint_every, 0)
        scalars = tensorboard(self.run_folder) if self.tensorboard else nullcontext()
        with scalars, collect_notes(), in_one_line(self.run_folder), bars():
            rasterizer, _ = select_rasterizer(self.device)
            block = BlockRun(run, plan, self.block)
            scene = extract.load(block.views_file).scene  # the data set may be much larger
            return train_block(RunContext(run, scene, rasterizer, intervals, caches), block, self.patience)


COMMAND = TrainBlockCommand
