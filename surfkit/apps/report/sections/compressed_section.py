"""What became of size, quality and speed in the compressed model."""

from __future__ import annotations

from collections.abc import Sequence

from surfkit.apps.report.elements import Section, TableCell, TableElement
from surfkit.apps.report.json_values import as_bytes, mapping, number, numeric, value_at
from surfkit.apps.report.run_files import RunFiles

COMPRESSED_SCORES = (("PSNR, dB", "images", "psnr", 2), ("SSIM", "images", "ssim", 3), ("F1", "geometry", "f1", 3))


def compressed(runs: Sequence[RunFiles]) -> Section | None:
    """A row for each run that has a compressed model."""
    rows = [_row(run) for run in runs if run.compressed]
    head = (
        "run",
        "compressor",
        "size",
        "of the PLY file",
        *(label for label, *_ in COMPRESSED_SCORES),
        "frames per second",
    )
    caption = "Compressed models, with the difference to the model before"
    return (
        Section("compressed", "Compressed model", (TableElement(caption, head, tuple(rows), True),)) if rows else None
    )


def _row(run: RunFiles) -> tuple[TableCell, ...]:
    size, before = number(run.compressed, "bytes"), number(run.compressed, "ply_bytes")
    after = mapping(run.metrics, "compressed")
    name = value_at(run.compressed, "compressor", "use")
    cells = [
        TableCell(run.name),
        TableCell(name if isinstance(name, str) else ""),
        numeric(size, as_bytes(size or 0.0)),
    ]
    share = size / before if size is not None and before else None
    cells.append(numeric(share, f"{share or 0:.1%}"))
    for _, kind, key, digits in COMPRESSED_SCORES:
        value, was = number(after, kind, key), number(run.metrics, kind, key)
        note = f"{value - was:+.{digits}f}" if value is not None and was is not None else ""
        cells.append(numeric(value, f"{value or 0:.{digits}f}", note))
    rates = after.get("fps_before_and_after")
    both = [number({"fps": rate}, "fps") for rate in rates] if isinstance(rates, list) else []
    if len(both) == 2 and both[0] is not None and both[1] is not None:
        return (*cells, numeric(both[1], f"{both[1]:.1f}", f"{both[1] - both[0]:+.1f}"))
    return (*cells, numeric(None, ""))
