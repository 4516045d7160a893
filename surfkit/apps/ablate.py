"""`surfkit ablate`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from surfkit.apps.ablation_forecast import foretell
from surfkit.cli.console_table import print_table
from surfkit.cli.tables import chosen_table
from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.core.registry import choice
from surfkit.io.datasets.data import ReadSettings
from surfkit.raster.select import Device
from surfkit.runs.execute.base import Executor, Inline
from surfkit.runs.run_stage import CHECKPOINT_EVERY
from surfkit.study.ablation import Table
from surfkit.study.ablation_screen import AblationScreen
from surfkit.study.ablation_warnings import lines_on_depth, row_numbers
from surfkit.study.foreign_meshes import OtherMesh
from surfkit.study.rows import Trial
from surfkit.study.shared_stages import sharing_lines
from surfkit.study.study import TABLE_WRITERS, AblationPlan, ablate, mesh_alone, report_so_far, trials
from surfkit.study.table_picture import write_picture
from surfkit.study.table_text import LEGEND, STACKED, drawing, failures, lines
from surfkit.study.truth import Truth


@dataclass(frozen=True)
class AblateCommand:
    """Train every row of an ablation table on the same data, and compare each row with the one it is built on.

    The table is table:NAME (`surfkit tables`), or one of your own: FILE.json, or FILE.py that defines TABLE; if none is
    named, it is table:model. Rows with the same recipe are trained once. An interrupted table continues when the same
    command is given again; with more seeds or rows, finished runs are kept. A row that fails does not stop the others.
    """

    default_table: ClassVar[str] = "model"

    table: Annotated[Table, chosen_table]
    """Ablation table."""

    data: tuple[Path, ...]
    """One data set or more; every row is trained on each, and the results stand side by side."""

    reading: Annotated[ReadSettings, tyro.conf.arg(name="")] = ReadSettings()
    """How the data sets are read."""

    steps: int | None = None
    """Optimisation steps of each run; schedules are scaled by the same factor. With fewer than 1,000 steps the model is
    hardly densified, and rows differ little."""

    max_points: int | None = None
    """Largest number of points of every row, so that rows are compared at equal size and fit into memory. Where a row
    cuts the scene, each block has the same limit: merged, they may come to more."""

    seeds: int = 1
    """Number of runs of each row, with seeds 0, 1, 2 and so on; with several, differences have a standard error."""

    gt: tuple[Path, ...] = ()
    """Ground truth of each data set in the order of --data, a mesh or a point cloud: the mesh of every row is compared
    with it, for F1. Rows without a mesher get mesh:tsdf then."""

    tau: tuple[float, ...] = ()
    """With --gt: distance threshold below which a point counts as correct, in units of the ground truth; one for each
    data set, or one for all. Required when the ground truth is a mesh."""

    meshes: tuple[str, ...] = ()
    """With --gt: meshes that other programs made of the same photographs, in the frame of the data set, each as
    LABEL=FILE, such as OpenMVS=scene_mesh.ply. They are measured as those of the rows are, and stand below them."""

    rows: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: all)")] = ()
    """Run only these rows, by label or number; finished results of the other rows are shown, too."""

    columns: Annotated[tuple[str, ...], tyro.conf.arg(help_behavior_hint="(default: all that were measured)")] = ()
    """Columns of the table, in this order: ssim, psnr, lpips, precision, recall, f1, accuracy, completeness, chamfer,
    normals_median, normals_p90, roughness_on_truth, roughness, boundary_share, components, non_manifold_edges,
    crossing_share, triangles, triangles_per_area, points, seconds, cpu_seconds, bytes, peak_memory_bytes,
    peak_gpu_bytes, fps. lpips is measured only if it is named, and what describes a mesh only with --gt."""

    show: bool = False
    """Run nothing, and write nothing: show what is finished."""

    out: Path | None = None
    """Folder of the results. Default: runs/DATA-ablate-TABLE."""

    device: Device = "auto"
    """Device for training and rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    executor: Annotated[Executor, choice(Executor)] = Inline()
    """Where the rows are trained: `executor:pool` trains several at the same time on this machine, `executor:ray` and
    `executor:slurm` use other machines. The results are the same."""

    shared: bool = True
    """Compute a stage that several rows have in common, such as pretraining, once; it is kept in OUT/stages. The
    results are the same."""

    checkpoint_every: int = CHECKPOINT_EVERY
    """Steps between checkpoints of a run. The last two are kept; an interruption writes one, too."""

    probe: int = 10
    """Optimisation steps that are measured on each data set to estimate time and disk of the table; 0 for no
    estimate."""

    def run(self) -> int:
        """Run the table and show it; 1 if a row failed."""
        data = tuple(self.reading.of(path) for path in self.data)
        names = "-".join(path.resolve().name for path in self.data)
        out = self.out or Path("runs") / f"{names}-ablate-{self.table.name}"
        plan = AblationPlan(
            self.table,
            data,
            out,
            self.steps,
            self.seeds,
            self.rows,
            self.device,
            self.max_points,
            truths(self.gt, self.tau),
            self.columns,
            self.executor,
            self.shared,
            tuple(map(OtherMesh.parsed, self.meshes)),
            self.checkpoint_every,
        )
        if self.show:
            show(report_so_far(plan))
            return 0
        try:
            with AblationScreen() as screen:
                report = ablate(plan, screen, self.before)
        except KeyboardInterrupt:
            say(f"{out} keeps what is finished; give the same command again to continue")
            raise
        show(report)
        print()
        picture = out / "ablation.png"
        written = [
            ("results", out / "ablation.json"),
            *(("table", out / f"ablation.{ending}") for ending in TABLE_WRITERS),
            *([("picture", picture)] if write_picture(picture, report) else []),
            ("runs", out / "runs"),
        ]
        print_table(("written", "path"), [(what, str(path)) for what, path in written])
        broken = failures(report)
        for line in broken:
            say(f"surfkit: {line}")
        return 1 if broken else 0

    def before(self, plan: AblationPlan, left: Sequence[Trial]) -> None:
        """Say what is known before the first run: which rows lack depth maps or are passed over, time and disk."""
        folders, labels = {trial.folder for trial in left}, [row.label for row in self.table.rows]
        for line in lines_on_depth([trial for trial in trials(plan) if trial.folder in folders], labels):
            say(f"note: {line}")
        if passed_over := mesh_alone(plan):
            which = f"{row_numbers(passed_over, labels)}, {' and '.join(passed_over)}"
            say(f"note: nothing compares meshes without --gt, so left out: {which}")
        if self.probe and left:
            foretell(plan, left, self.probe)


def truths(paths: Sequence[Path], taus: Sequence[float]) -> tuple[Truth, ...]:
    """The ground truths with their thresholds.

    Raises:
        BadInput: There are thresholds without truths, or not as many.
    """
    given = f"--tau {' '.join(f'{tau:g}' for tau in taus)}"
    if taus and not paths:
        raise BadInput(f"{given}: it needs --gt; add --gt, or leave it out")
    if len(taus) not in (0, 1, len(paths)):
        raise BadInput(f"{given}: {len(taus)} thresholds for {len(paths)} ground truths; give one for each, or one")
    every: Sequence[float | None] = [*taus] * len(paths) if len(taus) == 1 else taus or [None] * len(paths)
    return tuple(Truth(path, tau) for path, tau in zip(paths, every, strict=True))


def show(report: dict[str, Any]) -> None:
    """Print the table, fitted to a terminal, else one line a row; then what rows have shared."""
    if sys.stdout.isatty():
        from rich.console import Console

        console = Console()
        console.print(drawing(report))
        console.print(f"\n{LEGEND} {STACKED}", style="dim")
    else:
        print_table(*lines(report))
    for line in sharing_lines(report):
        say(line)


COMMAND = AblateCommand
