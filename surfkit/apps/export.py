"""`surfkit export`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from surfkit.apps.render.path import up_of
from surfkit.cli.console_table import tell
from surfkit.cli.recipes import ARGV
from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.lock import locked
from surfkit.core.memory import size
from surfkit.core.registry import choice, name_of
from surfkit.io.splats.base import Format
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.page import HtmlPageFormat
from surfkit.io.splats.ply import PLY
from surfkit.io.splats.splat_files import format_for, format_of, has_suffix, read_splat_file
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.tiles3d import Tiles3D
from surfkit.primitives.model import SplatModel
from surfkit.runs.folder import Run, refuse_no_run
from surfkit.runs.make_levels import load_levels
from surfkit.runs.pipeline import loaded
from surfkit.runs.run_method import splats_of
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.scene import Frame, Scene
from surfkit.train.faults import full_disk_in_one_line


def named_format() -> Format:
    """The format of the file name after --out on the command line, if no format is chosen; else PLY."""
    words = ARGV.get()
    if any(word.startswith("format:") for word in words):
        return PLY()  # is not used
    for at, word in enumerate(words):
        flag, _, value = word.partition("=")
        if flag == "--out" and (value := value or "".join(words[at + 1 : at + 2])):
            return format_for(Path(value))
    return PLY()


@dataclass(frozen=True)
class ExportCommand:
    """Write the splats of a finished run, or of a file of another program, in a format that viewers open.

    Coordinates are those of the data set. Examples: `surfkit export RUN --out scene.spz`, `surfkit export RUN --out
    page.html` (one file that shows the splats in a browser), `surfkit export scene.sog --format ply`, `surfkit export
    RUN format:spz --format.version 4`.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_OR_FILE")]
    """Folder that `surfkit train` made, or a file of splats in any format that can be read."""

    format: Annotated[Format, choice(Format)] = field(default_factory=named_format)
    """Format of the file; by default that of the suffix of --out, or ply."""

    out: Path | None = None
    """File to write; by default RUN/point_cloud with the suffix of the format, or beside FILE."""

    axes: AxesOrAuto = "auto"
    """Axes of the numbers in a FILE, as SPZ names them: rdf for right, down, forward, those of a PLY file. auto: those
    that the file names, or that its format has."""

    strict_2dgs: bool = False
    """Leave out the third scale of surfels, as programs written for 2DGS alone expect; ply only."""

    geoid: str | None = None
    """The geoid, where heights are above sea level: a grid of it (GTX, GeoTIFF), or the metres by which it lies above
    the ellipsoid; tiles3d only."""

    def __post_init__(self) -> None:
        if self.geoid is not None and not isinstance(self.format, Tiles3D):
            raise BadInput(
                f"--geoid: files of the format {name_of(self.format)} keep heights as they are; leave it out"
            )
        if self.strict_2dgs and not isinstance(self.format, PLY):
            raise BadInput(f"--strict-2dgs: files of the format {name_of(self.format)} have three scales; leave it out")
        if self.axes != "auto" and self.source.is_dir():
            raise BadInput(f"--axes {self.axes}: {self.source} is a run, whose axes are known; leave it out")

    def run(self) -> None:
        """Write the file, and say what is in it."""
        form, path = self._format(), self._path()
        with collect_notes(), self._opened() as (table, frame, tree, scene), full_disk_in_one_line(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(form, HtmlPageFormat) and scene is not None:
                form.write_seen(path, table, frame, scene.train, up_of(scene))
            else:
                form.write(path, table, frame, tree)
        table = form.kept(table)
        told = form.rounding(table)
        tell(f"wrote {len(table):,} splats to {path} ({name_of(form)}, {_size(path)}){told and ': '}{told}")
        has_place = isinstance(form, Tiles3D) and form.georeference and frame.crs
        if any(frame.shift) and not (has_place or isinstance(form, HtmlPageFormat)):
            tell(f"coordinates leave out the offset {' '.join(f'{value:.15g}' for value in frame.shift)}")

    def _format(self) -> Format:
        if isinstance(self.format, Tiles3D) and self.geoid is not None:
            return replace(self.format, geoid=self.geoid)
        if isinstance(self.format, PLY) and self.strict_2dgs:
            return replace(self.format, strict_2dgs=True)
        return self.format

    def _path(self) -> Path:
        """Where to write; BadInput for a place that the format cannot have."""
        suffix, path = self.format.suffix, self.out
        if path is None and self.source.is_dir():
            return self.source / (f"point_cloud{suffix}" if suffix else name_of(self.format))
        if path is None:
            path = self.source.with_name(_stem(self.source) + (suffix or f"-{name_of(self.format)}"))
        if suffix and path.suffix.lower() != f".{suffix.rpartition('.')[2]}":  # of .compressed.ply, .ply is enough
            raise BadInput(f"--out {path}: files of the format {name_of(self.format)} end in {suffix}; name it so")
        if suffix and path.is_dir():
            raise BadInput(f"--out {path}: a folder; name a file")
        if path.exists() and self.source.exists() and path.samefile(self.source):
            raise BadInput(f"--out {path}: this is the file that is read; name another")
        return path

    @contextmanager
    def _opened(self) -> Iterator[tuple[SplatTable, Frame, Tile | None, Scene | None]]:
        """Within, the splats in the frame of the input, that frame, their tiles if the format wants some, and the scene
        of a run."""
        if not self.source.is_dir():
            table = read_splat_file(self.source, self.axes)
            tree = one_tile(table) if self.format.wants_tree else None
            yield table, Frame.of_positions(table.means.numpy()), tree, None
            return
        refuse_no_run(self.source)
        with locked(self.source) if self.out is None else nullcontext(), loaded(self.source, "cpu") as (ctx, made):
            splats, frame = splats_of(ctx.run, made), ctx.scene.frame
            table = splats.primitive.table(splats.params).in_input_frame(frame)
            tree = self._tiles(ctx.run, splats, table, frame) if self.format.wants_tree else None
            yield table, frame, tree, ctx.scene

    def _tiles(self, run: Run, model: SplatModel, table: SplatTable, frame: Frame) -> Tile:
        """The levels of detail of a run; all splats in one tile if it has none."""
        if run.lod_record.exists():
            return load_levels(run, model).tiles(frame)
        remedy = f"`{run.to_paste('lod')}` makes them"
        emit(Warned(f"{self.source} has no levels of detail, so viewers load all splats at once; {remedy}"))
        return one_tile(table)


def _stem(path: Path) -> str:
    """The name of a file without the suffix of its format."""
    form = format_of(path)
    return path.name[: -len(form.suffix)] if form.suffix and has_suffix(path, form) else path.stem


def one_tile(table: SplatTable) -> Tile:
    """All splats in one tile."""
    means = table.means.double().numpy() if len(table) else np.zeros((1, 3))
    return Tile(table, means.min(0), means.max(0))


def _size(path: Path) -> str:
    """Of a file, or of all files in a folder, in words."""
    files = [path] if path.is_file() else [inner for inner in path.rglob("*") if inner.is_file()]
    count = sum(file.stat().st_size for file in files)
    return size(count) if count >= 1e7 else f"{count / 1e6:.2g} MB"


COMMAND = ExportCommand
