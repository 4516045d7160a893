"""`surfkit prepare depth`: depth maps of a data set, also as the last stage of `surfkit prepare photos`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console

from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput, printable
from surfkit.core.events import Progress, Warned, emit, say
from surfkit.core.files import sweep
from surfkit.core.lock import locked
from surfkit.core.registry import choice
from surfkit.depth.base import DepthEstimator
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.prepare_depth_maps import WITHOUT_DEPTH, DepthPreparation, EstimatedPhoto
from surfkit.evaluate.images.comparison_pictures import colour_depth, write_picture
from surfkit.io.datasets.data import ReadSettings
from surfkit.io.datasets.depth_files import DEPTH_FOLDER, DEPTH_RECORD, DepthFile, map_path
from surfkit.io.datasets.depth_prior import trust_warning
from surfkit.io.datasets.read import read
from surfkit.raster.select import Device, torch_device
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.photos import read_photo
from surfkit.scene.scene import View
from surfkit.train.progress_bars import bars

OVERVIEW = "overview.png"
OVERVIEW_VIEWS = 4
"""Views in the overview."""


@dataclass(frozen=True)
class PrepareDepthCommand:
    """Estimate depth maps of the training photographs, for the depth loss; writes DATA/estimated_depths.

    An interrupted command continues when it is given again. Damaged photographs are passed over. Two methods are
    multi-view stereo and need no network weights: `estimator:patch-match`, the default, which gives normals too, and
    `estimator:plane-sweep`, which is slower, and also runs where surfkit was installed without a C++ compiler. The
    network `estimator:depth-anything-v2` looks at one photograph at a time.
    """

    data: Annotated[Path, tyro.conf.Positional]
    """Data set: images/ and a COLMAP model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, or another layout."""

    estimator: Annotated[DepthEstimator, choice(DepthEstimator)] = PatchMatch()
    """Method that estimates depth."""

    again: bool = False
    """Also estimate depth maps again that exist already, such as with other settings."""

    reading: Annotated[ReadSettings, tyro.conf.arg(name="")] = ReadSettings()
    """How the data set is read."""

    device: Device = "auto"
    """Device for the estimate: auto, cpu, cuda, cuda:1, or that of a rasterizer, by its name (`surfkit components
    rasterizer`)."""

    def run(self) -> None:
        """Estimate, and print the results."""
        with collect_notes():
            done = self.make()
        show(done)
        tell(f"depth maps in {str(self.folder)!r}; picture of some: {str(self.folder / OVERVIEW)!r}")

    @property
    def folder(self) -> Path:
        """Where the maps are written."""
        return self.data / DEPTH_FOLDER

    def make(self, renew: bool = False) -> list[EstimatedPhoto]:
        """Estimate what is not there, and return what was estimated.

        Args:
            renew: Estimate maps again that surfkit made otherwise: with other settings, of other cameras, or of
                photographs that have changed since.

        Raises:
            BadInput: There are maps that are not to be replaced, or nothing can be estimated.
        """
        data = self.reading.of(self.data, test_every=0)
        preparation = DepthPreparation(data, self.estimator, torch_device(self.device))
        scene = read(data)
        if notice := self.estimator.notice():
            emit(Warned(notice))
        given = preparation.material(scene)
        views = given.views
        with locked(self.folder):
            sweep(self.folder)
            with bars():
                given, wanted = preparation.begin(scene, given, self.again, renew)
            if there := len(views) - len(preparation.lacking(scene)):
                print(f"{there} of {len(views)} photographs have depth maps already", file=sys.stderr)
            done = with_progress(preparation.run(scene, given, wanted), len(wanted))
            refuse_none(self.data, views, len(wanted))
            write_overview(self.folder / OVERVIEW, self.data, views)
        return done


def with_progress(steps: Iterable[EstimatedPhoto], total: int) -> list[EstimatedPhoto]:
    """The results, with bars on a terminal while they come; where there is no terminal, a line for each."""
    console, done = Console(stderr=True), []
    with bars(console):
        for step in steps:
            done.append(step)
            if console.is_terminal:
                emit(Progress("depth maps", len(done), total))
                continue
            covered = "nothing" if step.coverage is None else f"{step.coverage:.0%} covered"
            line = f"{len(done)}/{total} {step.view.name}: {covered}, {step.seconds:.1f} s"
            console.print(printable(line), highlight=False, soft_wrap=True, markup=False)
    return done


def show(done: list[EstimatedPhoto]) -> None:
    """What was estimated, as a table, and by name what was not."""
    covered = [step.coverage for step in done if step.coverage is not None]
    mean = f"{sum(covered) / len(covered):.0%}" if covered else "-"
    least = f"{min(covered):.0%}" if covered else "-"
    row = (str(len(covered)), mean, least, f"{sum(step.seconds for step in done):.1f}")
    print_table(("photographs", "covered", "least covered", "seconds"), [row])
    if failed := [step.view.name for step in done if step.coverage is None]:
        tell(f"too few sparse points or neighbours, no depth: {', '.join(failed)}")
    if covered and (text := trust_warning(sum(covered) / len(covered))):
        say(f"note: {text}")


def refuse_none(root: Path, views: Sequence[View], tried: int) -> None:
    """BadInput if no view has a map, though so many were tried; then nothing says that there are some."""
    if not any(map_path(root, view.name).exists() for view in views):
        (root / DEPTH_FOLDER / DEPTH_RECORD).unlink(missing_ok=True)
        raise BadInput(f"{root}: no depth can be estimated of any of {tried} photographs: they {WITHOUT_DEPTH}")


def write_overview(path: Path, root: Path, views: Iterable[View]) -> None:
    """A picture of a few views: photograph, depth and confidence."""
    found = [view for view in views if map_path(root, view.name).exists()]
    rows = []
    for view in found[:: max(1, len(found) // OVERVIEW_VIEWS)][:OVERVIEW_VIEWS]:
        file = DepthFile(map_path(root, view.name), aligned=True)
        inverse, confidence = torch.from_numpy(file.read()), file.read_confidence()
        height, width = inverse.shape
        trust = torch.zeros(height, width) if confidence is None else torch.from_numpy(confidence)
        try:
            photo = read_photo(view.path, (width, height), pixels=view.pixels).float() / 255
        except BadInput:  # damaged since its map was made
            continue
        rows.append(torch.cat([photo, colour_depth(1 / inverse), trust.expand(3, -1, -1)], dim=2))
    if rows:
        width = max(row.shape[2] for row in rows)
        write_picture(path, torch.cat([torch.nn.functional.pad(row, (0, width - row.shape[2])) for row in rows], dim=1))
