"""Figures of a quality report, drawn by matplotlib at the resolution of print."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from surfkit.apps.quality.document import PRINT_WIDTH_MM, Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

DPI = 170
"""Of figures in print."""
JPEG_QUALITY = 85
"""Of figures that show photographs or shading."""
SCALE_BAR_SHARE = 0.3
"""Of the width of a map, at most, that its scale bar takes."""
FONT_POINTS = 7.5
"""Of labels."""


def drawing(share: float = 1.0, height: float = 0.6) -> tuple[Drawing, Axes]:
    """An empty figure and its axes.

    Args:
        share: Of the width of the page.
        height: As a share of its own width.
    """
    from matplotlib.figure import Figure as Canvas

    width = share * PRINT_WIDTH_MM / 25.4
    canvas = Canvas(figsize=(width, width * height), dpi=DPI, layout="constrained")
    return canvas, canvas.add_subplot()


def styled() -> Any:
    """Within, matplotlib draws as all figures of a report are drawn, whatever the user has configured."""
    import matplotlib

    return matplotlib.rc_context({
        **matplotlib.rcParamsDefault, "font.size": FONT_POINTS, "axes.titlesize": FONT_POINTS + 0.5,
        "axes.linewidth": 0.6, "axes.spines.top": False, "axes.spines.right": False, "backend": "agg",
        "legend.fontsize": FONT_POINTS - 0.5, "legend.frameon": False,
    })  # fmt: skip


def finished(canvas: Drawing, title: str, share: float = 1.0, note: str = "", photographic: bool = False) -> Figure:
    """A drawing as a figure of the document: PNG of 256 colours, or JPEG where it shows photographs or shading."""
    raw = io.BytesIO()
    canvas.savefig(raw, format="png", dpi=DPI, bbox_inches="tight", pad_inches=0.02)
    image = Image.open(raw).convert("RGB")
    target = io.BytesIO()
    if photographic:
        image.save(target, "JPEG", quality=JPEG_QUALITY)
    else:
        few = image.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        few.save(target, "PNG", optimize=True)
    cut = image.width / DPI * 25.4 / PRINT_WIDTH_MM  # labels keep their size where empty margins are cut off
    return Figure(title, target.getvalue(), image.size, min(share, cut), note)


def as_map(axes: Axes, bounds: tuple[float, float, float, float], unit: str, georeferenced: bool) -> None:
    """Give axes the extent of a map, a scale bar and, if north is known, its arrow.

    Args:
        axes: Of the drawing.
        bounds: West, south, east, north.
        unit: Of lengths; "units" has a scale bar all the same.
        georeferenced: Whether the axes are those of a coordinate reference system.
    """
    west, south, east, north = bounds
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal")
    labels = ("easting", "northing") if georeferenced else ("x", "y")
    axes.set(xlabel=f"{labels[0]}, {unit}", ylabel=f"{labels[1]}, {unit}")
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.locator_params(nbins=5)
    axes.tick_params(axis="y", labelrotation=90)
    length = round_length(SCALE_BAR_SHARE * (east - west))
    left, low, high = west + 0.04 * (east - west), south + 0.04 * (north - south), 0.012 * (north - south)
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
    axes.barh(low, length, high, left, color="black", align="edge", zorder=9)
    axes.barh(low, length / 2, high, left, color="white", edgecolor="black", linewidth=0.5, align="edge", zorder=9)
    axes.text(left, low + 1.8 * high, f"{length:g} {unit}", va="bottom", bbox=box, zorder=9)
    if georeferenced:
        arrow = {"arrowstyle": "-|>", "color": "black", "linewidth": 1.0}
        axes.annotate(
            "N", (0.955, 0.97), (0.955, 0.86), "axes fraction", "axes fraction", arrow, ha="center", bbox=box, zorder=9
        )  # fmt: skip


def round_length(most: float) -> float:
    """1, 2 or 5 times a power of ten, at most this."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(times * power for times in (1, 2, 5) if times * power <= most * (1 + 1e-9)))


def bounds_about(xy: np.ndarray, margin: float = 0.05) -> tuple[float, float, float, float]:
    """West, south, east, north about (N, 2) places, with a margin as a share of the larger side."""
    low, high = xy.min(0), xy.max(0)
    extra = margin * max(float((high - low).max()), 1e-9)
    return (*(low - extra).tolist(), *(high + extra).tolist())


def histogram(values: np.ndarray, bins: Any, title: str, across: str, up: str, share: float = 0.5) -> Figure:
    """A histogram of (N,) values over bins; what lies beyond counts in the outer ones."""
    with styled():
        canvas, axes = drawing(share, 0.62)
        edges = np.histogram_bin_edges(values, bins)
        axes.hist(
            np.clip(values, edges[0], edges[-1]), edges.tolist(), color="#4c7fb5", edgecolor="white", linewidth=0.3
        )
        axes.set(xlabel=across, ylabel=up, xlim=(edges[0], edges[-1]))
        if np.issubdtype(np.asarray(values).dtype, np.integer):
            axes.locator_params(axis="x", integer=True)
        return finished(canvas, title, share)
