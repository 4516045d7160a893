"""`surfkit compress`."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from surfkit.apps.run_summary import compressed_rows
from surfkit.cli.console_table import print_table, tell
from surfkit.cli.recipes import ARGV, part_of_run
from surfkit.compress.base import Compressor
from surfkit.compress.format import model_of_file
from surfkit.compress.packed import Packed
from surfkit.compress.vectree import Vectree
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.core.registry import choice, name_of
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.raster.select import Device
from surfkit.runs.compress_model import CompressionTarget, compress_run, fitted, size_with, writing
from surfkit.runs.folder import Run
from surfkit.runs.journal import record_events
from surfkit.runs.measure_run import measure_compressed
from surfkit.runs.pipeline import loaded
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.available_memory import cache_bytes
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class CompressCommand:
    """Compress the model of a finished run into RUN/compressed/model.surfkit, and measure it; or a file of splats.

    Settings that are not given are those of the run's recipe. Example: `surfkit compress RUN compress:packed
    --target-loss 0.05dB`. `surfkit mesh RUN --compressed` and `evaluate RUN --compressed` use the compressed model;
    `export`, `import` and `start:splats` read its file.
    """

    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder that `surfkit train` made; or a file of splats, for compressors that need no photographs."""

    compress: Annotated[Compressor, choice(Compressor)] = field(
        default_factory=partial(part_of_run, "compress", Packed)
    )
    """How the model is compressed; by default as the recipe of the run says, else packed."""

    target_size: str | None = None
    """Choose the scale of all errors so that the file takes at most this, such as 50MB."""

    target_loss: str | None = None
    """Choose the scale of all errors so that PSNR on training views falls by at most this, such as 0.05dB."""

    out: Path | None = None
    """For a FILE: file to write, ending in .surfkit; beside it by default."""

    axes: AxesOrAuto = "auto"
    """Axes of the numbers in a FILE, as SPZ names them: rdf for right, down, forward, those of a PLY file. auto: those
    that the file names, or that its format has."""

    device: Device = "auto"
    """Device for rendering and for codebooks."""

    _is_named: ClassVar[bool] = False

    def __post_init__(self) -> None:
        is_named = any(word.startswith(("compress:", "--compress.")) for word in ARGV.get())
        object.__setattr__(self, "_is_named", is_named)  # the words are known only while they are parsed
        if self.target_size is not None and self.target_loss is not None:
            raise BadInput("--target-size and --target-loss: give one of the two")

    def run(self) -> None:
        """Compress, measure, and print the results."""
        wanted = CompressionTarget(
            None if self.target_size is None else size_of(self.target_size),
            None if self.target_loss is None else decibels(self.target_loss),
        )
        with collect_notes(), bars():
            if self.target.is_dir():
                self._run(wanted)
            else:
                self._file(wanted)

    def _run(self, wanted: CompressionTarget) -> None:
        if self.axes != "auto":
            raise BadInput(f"--axes {self.axes}: {self.target} is a run, whose axes are known; leave --axes out")
        if self.out is not None:
            raise BadInput(f"--out {self.out}: a run keeps its compressed model in its folder; leave --out out")
        with loaded(self.target, self.device) as (ctx, made):
            run = ctx.run
            with locked(run.out), full_disk_in_one_line(run.out), record_events(run.out):
                record = compress_run(ctx, made, self.compress, wanted)
                metrics = measure_compressed(ctx, made) if made.draw is not None else None
                other = None if wanted.is_set or self._is_named else other_of(self.compress)
                size = None if other is None else size_with(ctx, made, other)
        show(run, record, metrics)
        if other is not None and size is not None:
            share = record["bytes"] / size
            compared = f"{share:.1f} times smaller" if share > 1 else f"{1 / share:.1f} times larger"
            print(f"\nWith compress:{name_of(other)} it would be about {size / 1e6:.2f} MB, {compared}.")

    def _file(self, wanted: CompressionTarget) -> None:
        if wanted.decibels is not None:
            raise BadInput("--target-loss needs a run, whose photographs tell what is lost; use --target-size")
        model, frame = model_of_file(self.target, self.axes)
        path = self.out or self.target.with_suffix(".surfkit")
        if path.suffix.lower() != ".surfkit":
            raise BadInput(f"--out {path}: the name must end in .surfkit")
        if path.resolve() == self.target.resolve():
            raise BadInput(f"{self.target}: the file itself would be replaced; name another with --out")
        write = writing(model, None, frame, 0)
        with full_disk_in_one_line(path.parent):
            size = write(path, fitted(self.compress, wanted, write) if wanted.is_set else self.compress)
        before = self.target.stat().st_size
        tell(
            f"wrote {len(model):,} points to {path}: {size:,} bytes, {before / size:.1f} times fewer than {self.target}"
        )


def other_of(compressor: Compressor) -> Compressor | None:
    """What a default is compared with: the smallest, or that of the paper."""
    if isinstance(compressor, Packed):
        return Vectree()
    return Packed() if isinstance(compressor, Vectree) else None


def size_of(text: str) -> int:
    """Bytes of a size such as 50MB."""
    if text.strip().lower() == "auto":
        raise BadInput("--target-size auto: give a size such as 50MB")
    return cache_bytes(text, "--target-size")


def decibels(text: str) -> float:
    """A loss as users write it: 0.05 or 0.05dB.

    Raises:
        BadInput: Something else.
    """
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(dB)?", text, re.IGNORECASE)
    if found is None or not 0 < float(found[1]) <= 100:
        raise BadInput(f"--target-loss {text}: give a loss of PSNR above 0, such as 0.05dB")
    return float(found[1])


def show(run: Run, record: dict[str, Any], metrics: dict[str, Any] | None) -> None:
    """Print what became of size and quality, and the paths of what was written."""
    print_table(("compressed", "before", "after"), compressed_rows(record, metrics))
    print()
    paths = [run.compressed_model, run.compressed_record]
    print_table(("written",), [(str(path),) for path in paths])


COMMAND = CompressCommand
