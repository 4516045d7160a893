"""`surfkit compress`."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.cli.recipes import part_of_run
from surfkit.cli.result import compressed_rows
from surfkit.cli.table import print_table, tell
from surfkit.compress.base import Compressor
from surfkit.compress.format import model_of_file
from surfkit.compress.vectree import Vectree
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.core.registry import choice
from surfkit.pipeline import loaded
from surfkit.raster.select import Device
from surfkit.run.compress import Target, compress_run, fitted, writing
from surfkit.run.folder import Run
from surfkit.run.journal import record_events
from surfkit.run.measure import measure_compressed
from surfkit.run.notes import collect_notes
from surfkit.scene.memory import cache_bytes
from surfkit.train.bars import bars
from surfkit.train.faults import full_disk_in_one_line


@dataclass(frozen=True)
class Compress:
    """Compress the model of a finished run into RUN/compressed/model.surfkit, and measure it; or a file of splats.

    Settings that are not given are those of the run's recipe. Example: `surfkit compress RUN compress:packed
    --target-loss 0.05dB`. `surfkit mesh RUN --compressed` and `evaluate RUN --compressed` use the compressed model;
    `export`, `import` and `start:splats` read its file.
    """

    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder that `surfkit train` made; or a file of splats, for compressors that need no photographs."""

    compress: Annotated[Compressor, choice(Compressor)] = field(
        default_factory=partial(part_of_run, "compress", Vectree)
    )
    """How the model is compressed."""

    target_size: str | None = None
    """Choose the scale of all errors so that the file takes at most this, such as 50MB."""

    target_loss: str | None = None
    """Choose the scale of all errors so that PSNR on training views falls by at most this, such as 0.05dB."""

    out: Path | None = None
    """For a FILE: file to write, ending in .surfkit; beside it by default."""

    device: Device = "auto"
    """Device for rendering and for codebooks."""

    def __post_init__(self) -> None:
        if self.target_size is not None and self.target_loss is not None:
            raise BadInput("--target-size and --target-loss: give one of the two")

    def run(self) -> None:
        """Compress, measure, and print the results."""
        wanted = Target(
            None if self.target_size is None else size_of(self.target_size),
            None if self.target_loss is None else decibels(self.target_loss),
        )
        with collect_notes(), bars():
            if self.target.is_dir():
                self._run(wanted)
            else:
                self._file(wanted)

    def _run(self, wanted: Target) -> None:
        if self.out is not None:
            raise BadInput(f"--out {self.out}: a run keeps its compressed model in its folder; leave --out out")
        with loaded(self.target, self.device) as (ctx, made):
            run = ctx.run
            with locked(run.out), full_disk_in_one_line(run.out), record_events(run.out):
                record = compress_run(ctx, made, self.compress, wanted)
                metrics = measure_compressed(ctx, made) if made.draw is not None else None
        show(run, record, metrics)

    def _file(self, wanted: Target) -> None:
        if wanted.decibels is not None:
            raise BadInput("--target-loss needs a run, whose photographs tell what is lost; use --target-size")
        model, frame = model_of_file(self.target)
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


COMMAND = Compress
