"""A chart of precision and recall over the distance threshold, drawn with Pillow alone."""

from __future__ import annotations

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
LINES = {"F1": (200, 200, 200), "precision": (30, 100, 190), "recall": (222, 120, 20)}


def write_chart(path: Path, taus: np.ndarray, values: np.ndarray, tau: float, title: str) -> None:
    """Save a chart as PNG.

    Args:
        path: Where.
        taus: (T,) thresholds, rising from 0.
        values: (T, 2) precision and recall there.
        tau: The threshold that counts, drawn as a line.
        title: Above it.
    """
    width, height = (side * ONCE_MORE for side in SIZE)
    image = Image.new("RGB", (width, height), "white")
    pen, font = ImageDraw.Draw(image), ImageFont.load_default(14 * ONCE_MORE)

    def at(x: float, y: float) -> tuple[float, float]:
        across = LEFT + (SIZE[0] - LEFT - RIGHT) * x / taus[-1]
        return across * ONCE_MORE, (TOP + (SIZE[1] - TOP - BOTTOM) * (1 - y)) * ONCE_MORE

    for share in np.linspace(0, 1, 6):
        pen.line([at(0, share), at(taus[-1], share)], GRID, ONCE_MORE)
        pen.text((at(0, share)[0] - 8 * ONCE_MORE, at(0, share)[1]), f"{share:.1f}", INK, font, "rm")
    for mark in np.linspace(0, taus[-1], 6):
        pen.line([at(mark, 0), at(mark, 1)], GRID, ONCE_MORE)
        pen.text((at(mark, 0)[0], at(mark, 0)[1] + 8 * ONCE_MORE), f"{mark:.3g}", INK, font, "mt")
    pen.line([at(tau, 0), at(tau, 1)], INK, ONCE_MORE)
    pen.text((at(tau, 0)[0] + 5 * ONCE_MORE, at(0, 0)[1] - 6 * ONCE_MORE), "tau", INK, font, "ls")
    total = values.sum(1)
    f1 = np.divide(2 * values.prod(1), total, out=np.zeros_like(total), where=total > 0)
    for color, line, wide in zip(LINES.values(), (f1, *values.T), (4, 2, 2), strict=True):
        pen.line([at(x, y) for x, y in zip(taus, line, strict=True)], color, wide * ONCE_MORE, "curve")
    for i, (name, color) in enumerate(LINES.items()):
        pen.text(((LEFT + 90 * i) * ONCE_MORE, (SIZE[1] - 12) * ONCE_MORE), name, color, font, "ls")
    pen.text(((SIZE[0] - RIGHT) * ONCE_MORE, (SIZE[1] - 12) * ONCE_MORE), "distance", INK, font, "rs")
    pen.text((LEFT * ONCE_MORE, 14 * ONCE_MORE), title, INK, font)
    with replacing(path) as file:
        image.resize(SIZE, Image.Resampling.LANCZOS).save(file, "PNG")
