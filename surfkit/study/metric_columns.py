"""The columns of an ablation table: what is measured of a run, and how its numbers are written."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from surfkit.core.check import BadInput
from surfkit.core.registry import unknown

THOUSANDS = ((1e9, "G"), (1e6, "M"), (1e3, "k"))
"""Factors of units, from the largest."""


@dataclass(frozen=True)
class MetricColumn:
    """One measurement.

    Attributes:
        head: Its name for people.
        digits: After the point.
        better: Whether a higher or a lower number is the better one.
        factor: From the stored number to the one that is written.
        unit: Of the number; "B" and "" of `scaled` ones get a prefix.
        scaled: Write large numbers as thousands, millions or billions.
        in_percent: Write differences as a share of the number that they are to.
        by_default: Show it without being asked where it was measured; other columns are shown by tables that name them.
    """

    head: str
    digits: int
    better: Literal["higher", "lower"]
    factor: float = 1.0
    unit: str = ""
    scaled: bool = False
    in_percent: bool = False
    by_default: bool = True

    def text(self, value: float, spread: float | None = None) -> str:
        """A number with its standard deviation, such as "23.50 ± 0.71" or "9.54 M"."""
        factor, unit, digits = self._scale(value)
        tail = "" if spread is None else f" ± {spread * factor:,.{digits}f}"
        return f"{value * factor:,.{digits}f}{tail}{unit and ' ' + unit}"

    def difference(self, value: float, base: float, error: float | None = None) -> str:
        """A difference with its standard error; in percent of `base` where that is how the column is compared."""
        if self.in_percent and base == 0:
            return ""
        factor, digits, unit = (100 / abs(base), 1, " %") if self.in_percent else (self.factor, self.digits, "")
        tail = "" if error is None else f" ± {error * factor:.{digits}f}"
        return f"{value * factor:+.{digits}f}{tail}{unit}"

    def _scale(self, value: float) -> tuple[float, str, int]:
        """Factor, unit and digits to write a number with."""
        if not self.scaled:
            return self.factor, self.unit, self.digits
        for size, prefix in THOUSANDS:
            if value >= size and (prefix != "k" or self.unit):  # a count below a million is written in full
                return 1 / size, prefix + self.unit, self.digits
        return 1.0, self.unit, 0


TABLE_COLUMNS = {
    "ssim": MetricColumn("SSIM", 3, "higher"),
    "psnr": MetricColumn("PSNR", 2, "higher"),
    "ssim_aligned": MetricColumn("SSIM, aligned", 3, "higher", by_default=False),
    "psnr_aligned": MetricColumn("PSNR, aligned", 2, "higher", by_default=False),
    "lpips": MetricColumn("LPIPS", 3, "lower", by_default=False),
    "precision": MetricColumn("P", 3, "higher"),
    "recall": MetricColumn("R", 3, "higher"),
    "f1": MetricColumn("F1", 3, "higher"),
    "accuracy": MetricColumn("accuracy", 3, "lower", by_default=False),
    "completeness": MetricColumn("completeness", 3, "lower", by_default=False),
    "chamfer": MetricColumn("chamfer", 3, "lower", by_default=False),
    "normals_median": MetricColumn("normals", 1, "lower", unit="deg", by_default=False),
    "normals_p90": MetricColumn("normals 90 %", 1, "lower", unit="deg", by_default=False),
    "roughness_on_truth": MetricColumn("rough", 3, "lower", by_default=False),
    "roughness": MetricColumn("rough, own planes", 3, "lower", by_default=False),
    "boundary_share": MetricColumn("boundary", 2, "lower", factor=100, unit="%", by_default=False),
    "components": MetricColumn("parts", 0, "lower", by_default=False),
    "non_manifold_edges": MetricColumn("non-manifold", 0, "lower", by_default=False),
    "crossing_share": MetricColumn("crossing", 3, "lower", factor=100, unit="%", by_default=False),
    "triangles": MetricColumn("triangles", 2, "lower", scaled=True, in_percent=True, by_default=False),
    "triangles_per_area": MetricColumn("per area", 1, "lower", in_percent=True, by_default=False),
    "points": MetricColumn("points", 2, "lower", scaled=True, in_percent=True),
    "seconds": MetricColumn("minutes", 1, "lower", factor=1 / 60, in_percent=True),
    "cpu_seconds": MetricColumn("CPU min", 1, "lower", factor=1 / 60, in_percent=True),
    "bytes": MetricColumn("size", 2, "lower", unit="B", scaled=True, in_percent=True),
    "peak_memory_bytes": MetricColumn("memory", 2, "lower", unit="B", scaled=True, in_percent=True),
    "peak_gpu_bytes": MetricColumn("GPU memory", 2, "lower", unit="B", scaled=True, in_percent=True),
    "fps": MetricColumn("FPS", 1, "higher", in_percent=True),
}
"""Every column by its name in ablation.json and on the command line, in the order of the paper's tables."""


MESH_COLUMNS = (
    "normals_median",
    "normals_p90",
    "roughness_on_truth",
    "roughness",
    "boundary_share",
    "components",
    "non_manifold_edges",
    "crossing_share",
    "triangles",
    "triangles_per_area",
)
"""What a mesh is beside its precision, recall and F1."""


def refuse_unknown_columns(names: Sequence[str]) -> None:
    """BadInput for a name that no column has, or that stands twice."""
    for at, name in enumerate(names):
        if name not in TABLE_COLUMNS:
            raise BadInput(f"--columns: {unknown('column', name, TABLE_COLUMNS)}")
        if name in names[:at]:
            raise BadInput(f"--columns: {name} is there twice; name each column once")


def shown_columns(asked: Sequence[str], measured: Collection[str], also: Collection[str] = ()) -> list[str]:
    """Names of the columns of a table: those that the user asked for, or else those that were measured.

    Args:
        asked: By the user; none for the default.
        measured: Names of the numbers that at least one row has.
        also: Names of columns that the table shows beside those by default.
    """
    if asked:
        return list(asked)
    found = [name for name, column in TABLE_COLUMNS.items() if (column.by_default or name in also) and name in measured]
    return found or ["ssim", "psnr", "points"]
