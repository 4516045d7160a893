"""Charts of lines, drawn by matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import printable
from surfkit.core.files import replacing

CHART_INCHES, CHART_DPI = (9.0, 5.6), 100
LEGEND_LETTERS = 90
"""Room for the names of the lines in one row."""


@dataclass(frozen=True)
class PlotLine:
    """One line of a chart.

    Attributes:
        name: What it is, for the legend.
        x: (T,) from 0 on.
        y: (T,) from 0 on.
        color: Name of a colour of matplotlib; the next one of its cycle by default.
        width: Points, 1/72 inch.
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    color: str | None = None
    width: float = 1.6


def write_lines(
    path: Path,
    lines: Sequence[PlotLine],
    title: str,
    x_label: str,
    top: float | None = None,
    mark: tuple[str, float] | None = None,
) -> None:
    """Save a chart of lines as PNG; both axes begin with 0.

    Args:
        path: Where.
        lines: Drawn in this order.
        title: Above it.
        x_label: What the horizontal axis is.
        top: Upper end of the vertical axis; above all lines by default.
        mark: Name and place of a vertical line.
    """
    import matplotlib
    from matplotlib.figure import Figure  # without pyplot: no window system is asked for, and nothing is kept
    from matplotlib.ticker import EngFormatter

    style = {**matplotlib.rcParamsDefault, "text.parse_math": False}  # names may have dollar signs
    with matplotlib.rc_context({name: style[name] for name in style if name != "backend"}):  # not the user's own style
        figure = Figure(CHART_INCHES, CHART_DPI, layout="constrained")
        axes = figure.add_subplot(title=printable(title), xlabel=x_label)
        drawn = [axes.plot(line.x, line.y, color=line.color, linewidth=line.width)[0] for line in lines]
        axes.set_xlim(0, max(float(line.x.max()) for line in lines) or 1)
        axes.set_ylim(0, top or 1.05 * max(float(line.y.max()) for line in lines) or 1)
        if mark is not None:
            axes.axvline(mark[1], color="0.2", linewidth=1)
            axes.annotate(mark[0], (mark[1], 0), xytext=(4, 4), textcoords="offset points")
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_view_interval()[1] >= 1e4:
                axis.set_major_formatter(EngFormatter(sep=""))  # 20k, 3M
        axes.grid(color="0.88")
        axes.set_axisbelow(True)
        names = [printable(line.name) for line in lines]
        columns = max(1, min(len(names), LEGEND_LETTERS // max(map(len, names))))
        figure.legend(drawn, names, loc="outside lower center", ncols=columns, frameon=False)
        with replacing(path) as file:
            figure.savefig(file, format="png", metadata={"Software": None})


def write_chart(path: Path, taus: np.ndarray, values: np.ndarray, tau: float, title: str) -> None:
    """Save a chart of precision and recall over the distance threshold.

    Args:
        path: Where.
        taus: (T,) thresholds, rising from 0.
        values: (T, 2) precision and recall there.
        tau: The threshold that counts, drawn as a vertical line.
        title: Above it.
    """
    total = values.sum(1)
    f1 = np.divide(2 * values.prod(1), total, out=np.zeros_like(total), where=total > 0)
    lines = [
        PlotLine("F1", taus, f1, "0.75", 3),
        PlotLine("precision", taus, values[:, 0], "tab:blue"),
        PlotLine("recall", taus, values[:, 1], "tab:orange"),
    ]
    write_lines(path, lines, title, "distance", top=1.0, mark=("tau", tau))
