"""Charts of lines, drawn with Pillow alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from surfkit.core.files import replacing

SIZE = (720, 460)
LEFT, TOP, RIGHT, BOTTOM = 64, 44, 24, 56
"""Room around the axes, pixels."""
ONCE_MORE = 2
"""Drawn so many times larger and then reduced, so that lines are smooth."""
INK, GRID = (40, 40, 40), (222, 222, 222)
GREY, BLUE, ORANGE = (200, 200, 200), (30, 100, 190), (222, 120, 20)
COLORS = (BLUE, ORANGE, (44, 140, 60), (190, 40, 50), (120, 90, 170), (120, 80, 60), (90, 90, 90))


@dataclass(frozen=True)
class Line:
    """One line of a chart.

    Attributes:
        name: What it is.
        x: (T,) from 0 on.
        y: (T,) from 0 on.
        color: Red, green and blue, 0 to 255.
        wide: Pixels.
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    color: tuple[int, int, int]
    wide: int = 2


def write_lines(
    path: Path, lines: Sequence[Line], title: str, across: str, top: float | None = None, mark: tuple[str, float] = ()
) -> None:
    """Save a chart of lines as PNG; both axes begin with 0.

    Args:
        path: Where.
        lines: Drawn in this order.
        title: Above it.
        across: What the horizontal axis is.
        top: Upper end of the vertical axis; a round number above all lines by default.
        mark: Name and place of an upright line.
    """
    width, height = (side * ONCE_MORE for side in SIZE)
    image = Image.new("RGB", (width, height), "white")
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(14 * ONCE_MORE)
    end = max(float(line.x.max()) for line in lines)
    top = top or round_above(max(float(line.y.max()) for line in lines))

    def at(x: float, y: float) -> tuple[float, float]:
        right = LEFT + (SIZE[0] - LEFT - RIGHT) * x / end
        return right * ONCE_MORE, (TOP + (SIZE[1] - TOP - BOTTOM) * (1 - y / top)) * ONCE_MORE

    for level in np.linspace(0, top, 6):
        pen.line([at(0, level), at(end, level)], GRID, ONCE_MORE)
        pen.text((at(0, level)[0] - 8 * ONCE_MORE, at(0, level)[1]), short(level, top), INK, font, "rm")
    for step in np.linspace(0, end, 6):
        pen.line([at(step, 0), at(step, top)], GRID, ONCE_MORE)
        pen.text((at(step, 0)[0], at(step, 0)[1] + 8 * ONCE_MORE), short(step, end), INK, font, "mt")
    if mark:
        pen.line([at(mark[1], 0), at(mark[1], top)], INK, ONCE_MORE)
        pen.text((at(mark[1], 0)[0] + 5 * ONCE_MORE, at(0, 0)[1] - 6 * ONCE_MORE), mark[0], INK, font, "ls")
    begin = LEFT
    for line in lines:
        pen.line([at(x, y) for x, y in zip(line.x, line.y, strict=True)], line.color, line.wide * ONCE_MORE, "curve")
        pen.text((begin * ONCE_MORE, (SIZE[1] - 12) * ONCE_MORE), line.name, line.color, font, "ls")
        begin += 18 + pen.textlength(line.name, font) / ONCE_MORE
    pen.text(((SIZE[0] - RIGHT) * ONCE_MORE, (SIZE[1] - 12) * ONCE_MORE), across, INK, font, "rs")
    pen.text((LEFT * ONCE_MORE, 14 * ONCE_MORE), title, INK, font)
    with replacing(path) as file:
        image.resize(SIZE, Image.Resampling.LANCZOS).save(file, "PNG")


def round_above(value: float) -> float:
    """The next of 1, 2, 2.5, 5 times a power of ten; 1 for nothing."""
    if not value > 0:
        return 1.0
    power = 10 ** math.floor(math.log10(value))
    return next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= value)


def short(value: float, largest: float) -> str:
    """A number on an axis that goes up to `largest`."""
    for least, unit, name in ((1e6, 1e6, "M"), (1e4, 1e3, "k")):
        if largest >= least and value:
            return f"{value / unit:.3g}{name}"
    return f"{value:,.0f}" if largest >= 100 else f"{value:.3g}"


def write_chart(path: Path, taus: np.ndarray, values: np.ndarray, tau: float, title: str) -> None:
    """Save a chart of precision and recall over the distance threshold.

    Args:
        path: Where.
        taus: (T,) thresholds, rising from 0.
        values: (T, 2) precision and recall there.
        tau: The threshold that counts, drawn as a line.
        title: Above it.
    """
    total = values.sum(1)
    f1 = np.divide(2 * values.prod(1), total, out=np.zeros_like(total), where=total > 0)
    named = zip(("F1", "precision", "recall"), (f1, *values.T), (GREY, BLUE, ORANGE), (4, 2, 2), strict=True)
    lines = [Line(name, taus, line, color, wide) for name, line, color, wide in named]
    write_lines(path, lines, title, "distance", top=1.0, mark=("tau", tau))
