"""Values out of the JSON of a run: what is not there, or not what it should be, is left out of the report."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from surfkit.apps.report.elements import TableCell

NO_VALUE = "\N{EN DASH}"
"""Shown where there is nothing."""


def value_at(data: Any, *path: str) -> Any:
    """What lies at a path of keys; None if there is nothing."""
    for key in path:
        data = data.get(key) if isinstance(data, Mapping) else None
    return data


def number(data: Any, *path: str) -> float | None:
    """A finite number at a path of keys, else None."""
    found = value_at(data, *path)
    is_number = isinstance(found, (int, float)) and not isinstance(found, bool)
    return float(found) if is_number and abs(found) < 1e300 and math.isfinite(found) else None


def mapping(data: Any, *path: str) -> dict[str, Any]:
    """An object at a path of keys, else an empty one."""
    found = value_at(data, *path)
    return found if isinstance(found, dict) else {}


def texts(data: Any, *path: str) -> list[str]:
    """The texts of a list at a path of keys."""
    found = value_at(data, *path)
    return [text for text in found if isinstance(text, str)] if isinstance(found, list) else []


def in_words(value: Any) -> str:
    """Any value of JSON in one line: bare texts, numbers as written, the rest as JSON."""
    if value is None:
        return "none"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def flat(data: Any, path: str = "") -> dict[str, Any]:
    """Values by dotted path, as on the command line; empty lists and objects are values, too."""
    if isinstance(data, dict) and data:
        parts = [flat(item, f"{path}.{key}" if path else str(key)) for key, item in data.items()]
    elif isinstance(data, list) and any(isinstance(item, (dict, list)) for item in data):
        parts = [flat(item, f"{path}.{at}") for at, item in enumerate(data)]
    else:
        return {path: data}
    return {name: value for part in parts for name, value in part.items()}


def as_bytes(size: float) -> str:
    """A size in bytes, in decimal units."""
    unit = next((at for at in range(4) if abs(size) < 999.5 * 1000**at), 3)
    return f"{size / 1000**unit:.3g} {('B', 'kB', 'MB', 'GB')[unit]}"


def as_duration(seconds: float) -> str:
    """Seconds, minutes or hours."""
    if abs(seconds) < 120:
        return f"{seconds:.3g} s"
    return f"{seconds / 60:.1f} min" if abs(seconds) < 7200 else f"{seconds / 3600:.1f} h"


@dataclass(frozen=True)
class Quantity:
    """A figure of a run.

    Attributes:
        label: Head of its column.
        paths: Where metrics.json may have it.
        digits: After the point.
        form: "number", "bytes" or "duration".
    """

    label: str
    paths: tuple[tuple[str, ...], ...]
    digits: int = 3
    form: str = "number"

    def shown(self, value: float) -> str:
        """The value as text, with its unit."""
        if self.form == "bytes":
            return as_bytes(value)
        return as_duration(value) if self.form == "duration" else f"{value:,.{self.digits}f}"

    def difference(self, value: float, base: float, spread: float | None = None) -> str:
        """How much more a value is than another one, with its standard error; in percent where sizes vary widely."""
        change, unit, digits = value - base, "", self.digits
        if self.form != "number" or self.digits == 0:
            if not base:
                return ""
            change, unit, digits = 100 * change / base, " %", 1
            spread = None if spread is None else 100 * spread / abs(base)
        text = f"{change:+.{digits}f}"
        text = text if float(text) else f"{0:.{digits}f}"
        return text + ("" if spread is None else f" ± {spread:.{digits}f}") + unit


QUANTITIES = {
    "psnr": Quantity("PSNR, dB", (("images", "psnr"),), 2),
    "psnr_aligned": Quantity("PSNR, colours aligned, dB", (("images", "psnr_aligned"),), 2),
    "ssim": Quantity("SSIM", (("images", "ssim"),)),
    "ssim_aligned": Quantity("SSIM, colours aligned", (("images", "ssim_aligned"),)),
    "lpips": Quantity("LPIPS", (("images", "lpips"), ("images", "lpips_vgg"))),
    "precision": Quantity("precision", (("geometry", "precision"),)),
    "recall": Quantity("recall", (("geometry", "recall"),)),
    "f1": Quantity("F1", (("geometry", "f1"),)),
    "normals_median": Quantity("normals, median angle, degrees", (("geometry", "normals", "median"),), 1),
    "normals_p90": Quantity("normals, 90 % within, degrees", (("geometry", "normals", "p90"),), 1),
    "roughness_on_truth": Quantity("roughness on planes of the truth", (("geometry", "roughness", "on_truth_planes"),)),
    "roughness": Quantity("roughness on planes of the mesh", (("mesh", "roughness", "on_planes"),)),
    "boundary_share": Quantity("share of boundary edges", (("mesh", "boundary_share"),), 4),
    "components": Quantity("connected parts", (("mesh", "components"),), 0),
    "non_manifold_edges": Quantity("non-manifold edges", (("mesh", "non_manifold_edges"),), 0),
    "crossing_share": Quantity("share of crossing triangles", (("mesh", "crossing", "share"),), 5),
    "triangles": Quantity("triangles", (("mesh", "triangles"),), 0),
    "triangles_per_area": Quantity("triangles per square metre or unit", (("mesh", "triangles_per_area"),), 1),
    "points": Quantity("points", (("points",),), 0),
    "steps": Quantity("steps", (("steps",),), 0),
    "seconds": Quantity("training", (("seconds",),), form="duration"),
    "cpu_seconds": Quantity("CPU time", (("cpu_seconds",),), form="duration"),
    "peak_memory_bytes": Quantity("peak memory", (("peak_memory_bytes",),), form="bytes"),
    "peak_gpu_bytes": Quantity("peak GPU memory", (("peak_gpu_bytes",),), form="bytes"),
    "bytes": Quantity("model size", (("bytes",),), form="bytes"),
    "fps": Quantity("frames/s", (("fps",),), 1),
}
"""What is compared, by the names that metrics.json and ablation tables have for it."""


def quantity(name: str) -> Quantity:
    """The quantity of a name; one of a package's own is shown as a plain number."""
    return QUANTITIES.get(name, Quantity(name.replace("_", " "), ((name,),)))


def of_metrics(metrics: Mapping[str, Any], name: str) -> float | None:
    """The figure of a run, by the name of a quantity."""
    found = (number(metrics, *path) for path in quantity(name).paths)
    return next((value for value in found if value is not None), None)


def plain(*items: Any) -> tuple[TableCell, ...]:
    """A row of a table out of cells and plain values."""
    return tuple(item if isinstance(item, TableCell) else TableCell(in_words(item)) for item in items)


def numeric(value: float | None, shown: str, note: str = "") -> TableCell:
    """A cell of a number, or of none."""
    return TableCell(NO_VALUE) if value is None else TableCell(shown, value, note)
