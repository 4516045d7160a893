"""Charts of lines as SVG, drawn by matplotlib; colours are variables of the page, so that they suit light and dark.

matplotlib and not a library of the browser: plotly.js is 4 MB and cannot be reached by keyboard, Vega needs an
interpreter where a policy forbids `eval`. The few lines that a cursor needs are in templates/page.js.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from surfkit.apps.report.elements import LegendEntry, LineChart

CHART_SIZE_INCHES = (5.6, 3.1)
AXES_BOX = (0.13, 0.17, 0.84, 0.79)
"""Left, bottom, width and height of the axes, as shares of the drawing; page.css sets the cursor by it."""
LINE_COLOR_COUNT = 8
"""Lines with a colour of their own; further ones have other dashes."""
DASHES: tuple[tuple[float, ...], ...] = ((), (6, 2), (2, 2), (8, 2, 2, 2))
INK_PLACEHOLDER, GRID_PLACEHOLDER, LINE_PLACEHOLDER = "#fe0001", "#fe0002", "#fe01{:02x}"
"""Stand for variables of the page while matplotlib draws."""


@dataclass(frozen=True)
class ChartSeries:
    """A line of a chart: its name and (2, T) steps and values, T at least 2."""

    name: str
    dots: np.ndarray


def chart(title: str, lines: Sequence[ChartSeries], x_label: str = "steps", top: float | None = None) -> LineChart:
    """A chart of lines over the same axis; the vertical axis begins with 0.

    Args:
        title: What the lines show, with the unit.
        lines: At least one.
        x_label: What the horizontal axis is: a text of our own.
        top: Upper end of the vertical axis; above all lines by default.
    """
    steps = max((line.dots[0] for line in lines), key=len)
    right = max(float(line.dots[0].max()) for line in lines) or 1.0
    entries = [
        LegendEntry(
            line.name,
            at % LINE_COLOR_COUNT,
            " ".join(map(str, DASHES[at // LINE_COLOR_COUNT % len(DASHES)])),
            f"{_readable(line.dots[1][0])} to {_readable(line.dots[1][-1])}",
        )
        for at, line in enumerate(lines)
    ]
    data = {
        "right": right,
        "label": x_label,
        "steps": steps.tolist(),
        "lines": [[[_short(value) for value in axis] for axis in line.dots] for line in lines],
    }
    return LineChart(title, _drawing(lines, right, top, x_label), tuple(entries), json.dumps(data), len(steps))


def _readable(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def _drawing(lines: Sequence[ChartSeries], right: float, top: float | None, x_label: str) -> str:
    """SVG without names of lines: the legend is a part of the page."""
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    style: dict[Any, Any] = {name: value for name, value in matplotlib.rcParamsDefault.items() if name != "backend"}
    colors = dict.fromkeys(
        ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK_PLACEHOLDER
    )
    own = {"svg.fonttype": "none", "svg.hashsalt": "surfkit", "font.size": 10, "text.parse_math": False}
    with matplotlib.rc_context(style | own | colors):
        figure = Figure(CHART_SIZE_INCHES)
        axes = figure.add_axes(AXES_BOX, xlabel=x_label, facecolor="none")
        for at, line in enumerate(lines):
            dashes = DASHES[at // LINE_COLOR_COUNT % len(DASHES)]
            color = LINE_PLACEHOLDER.format(at % LINE_COLOR_COUNT)
            axes.plot(*line.dots, color=color, linewidth=1.8, linestyle=(0, dashes or ()), clip_on=False)
        values = np.concatenate([line.dots[1] for line in lines])
        axes.set_xlim(0, right)
        axes.set_ylim(min(0.0, 1.05 * float(values.min())), top or 1.05 * float(values.max()) or 1.0)
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_view_interval()[1] >= 1e4:
                axis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(color=GRID_PLACEHOLDER, clip_on=False)
        axes.tick_params(length=0)  # without ticks and clipping nothing is referred to, and charts need no ids
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        file = io.StringIO()
        metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=metadata)
    return _inline(file.getvalue())


def _inline(svg: str) -> str:
    """An SVG file as part of a page: without its head, its style sheet, its fonts and its ids."""
    svg = svg[svg.index("<svg ") :].strip()
    svg = re.sub(r'<svg [^>]*viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true" focusable="false">', svg)
    svg = re.sub(r"<defs>.*?</defs>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' id="[^"]*"', "", svg)
    svg = re.sub(r"font(?:-family)?: [^;\"]*; ?", "", re.sub(r"font-size: [\d.]+px; ?", "", svg))
    svg = re.sub(r"\s*\n\s*", " ", svg).replace(INK_PLACEHOLDER, "var(--ink)").replace(GRID_PLACEHOLDER, "var(--grid)")
    for at in range(LINE_COLOR_COUNT):
        svg = svg.replace(LINE_PLACEHOLDER.format(at), f"var(--line-{at})")
    return svg
