"""What became of control points, their marks and the checkpoints: tables, warnings, proposals and arrows."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.sfm.control_list import GroundControl
from surfkit.apps.sfm.control_marks import images_of, propose
from surfkit.apps.sfm.ground_control import ControlResiduals
from surfkit.core.check import few
from surfkit.core.codec import write_text
from surfkit.core.files import remove

POINTS_TABLE, MARKS_TABLE, PROPOSED_LIST = "control_points.csv", "control_marks.csv", "proposed_marks.txt"
"""In the scene."""
POINT_COLUMNS = ("point", "role", "x", "y", "z", "residual_east_m", "residual_north_m", "residual_up_m", "marks")
MARK_COLUMNS = ("point", "role", "photograph", "pixel_x", "pixel_y", "residual_x_px", "residual_y_px", "used")
ARROW_SHARE = 0.08
"""Length of the longest arrow, as a share of the picture."""
LISTED_MARKS = 5
"""Wrong marks that are named one by one."""
FAR_TIMES, FAR_M = 10, 0.1
"""A checkpoint is far off from so many times the residuals of control points on, and so many metres."""
SYMBOLS = {"control": ("o", "tab:green"), "checkpoint": ("s", "tab:purple"), "left out": ("X", "red")}
"""Of points in the picture, by what they are."""


def warnings_of(where: ControlResiduals) -> Iterator[str]:
    """What is left out, a line for each kind."""
    sure = [mark for mark in where.wrong_marks if mark.certain]
    for mark in sure[:LISTED_MARKS]:
        there = "behind it" if mark.pixels is None else f"{mark.pixels:.1f} px away"
        yield (
            f"the mark of {mark.point!r} in {mark.photograph!r} is left out: by the marks in other photographs the "
            f"point is {there}"
        )
    if len(sure) > LISTED_MARKS:
        yield f"{len(sure) - LISTED_MARKS} more marks are left out: see wrong_marks in the report"
    pairs: dict[str, list[Any]] = {}
    for mark in where.wrong_marks:
        if not mark.certain:
            pairs.setdefault(mark.point, []).append(mark)
    for point, marks in pairs.items():
        known = [mark.pixels for mark in marks if mark.pixels is not None]
        how = f"by {sum(known):.1f} px" if len(known) == len(marks) else "as their rays do not meet in front of them"
        yield (
            f"the marks of {point!r} in {few([mark.photograph for mark in marks])} contradict each other, {how}, and "
            "are left out; one more mark would tell which is wrong"
        )
    if where.wrong:
        away = {name: float(np.linalg.norm(where.residuals[name])) for name in where.wrong}
        said = [f"{name} ({away[name]:.2f} m)" for name in where.wrong]
        yield (
            f"{len(said)} ground control points contradict the others and are left out: {few(said)}; the marks of each "
            "agree, so its surveyed place is wrong, or they are all on something else"
        )
    fit = math.hypot(*where.rms(where.control).values()) if where.control else 0.0
    off = {name: math.hypot(*where.residuals[name]) for name in where.checkpoints if name in where.residuals}
    if far := [f"{name} ({away:.2f} m)" for name, away in off.items() if away > max(FAR_TIMES * fit, FAR_M)]:
        yield (
            f"{len(far)} checkpoints are off by more than {FAR_TIMES} times what control points are ({fit:.2f} m RMS): "
            f"{few(far)}; their surveyed places are wrong, or the model bends away from the control points"
        )
    if where.unseen:
        yield (
            f"{len(where.unseen)} ground control points are in too few placed photographs and are left out: "
            f"{few(where.unseen)}"
        )


def write_tables(scene: Path, model: Any, where: ControlResiduals | None, ground: GroundControl | None) -> None:
    """Write the tables and the proposed marks of the model that is on the map, or remove those of before.

    Args:
        scene: The folder.
        model: pycolmap.Reconstruction with the cameras of the files, distorted.
        where: Its points; None without.
        ground: The list.
    """
    if where is None or ground is None:
        for name in (POINTS_TABLE, MARKS_TABLE, PROPOSED_LIST):
            remove(scene / name)
        return
    wrong = {(mark.point, mark.photograph): mark for mark in where.wrong_marks}
    rows, marks = [], []
    for point in ground.points:
        left, role = where.residuals.get(point.name), where.role(point.name)
        used = where.marks.get(point.name, {})
        residual = ["", "", ""] if left is None else [f"{value:.4f}" for value in left]
        rows.append([point.name, role, *map(repr, point.xyz), *residual, len(used)])
        for name, pixel in point.marks.items():
            off = [f"{value:.3f}" for value in used[name]] if name in used else ["", ""]
            what = "wrong" if (point.name, name) in wrong else "yes" if name in used else "no"
            marks.append([point.name, role, name, *map(repr, pixel), *off, what])
    _write_csv(scene / POINTS_TABLE, POINT_COLUMNS, rows)
    _write_csv(scene / MARKS_TABLE, MARK_COLUMNS, marks)
    places = {
        point.name: onto
        - (np.array(where.residuals[point.name]) / where.chart.metres if point.name in where.wrong else 0)
        for point, onto in zip(ground.points, ground.onto, strict=True)
    }
    points = [
        replace(point, marks={name: at for name, at in point.marks.items() if (point.name, name) not in wrong})
        for point in ground.points
    ]
    propose(scene / PROPOSED_LIST, ground.first, points, places, images_of(model))


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(rows)
    write_text(path, text.getvalue())


def point_rows(facts: dict[str, Any]) -> list[tuple[str, ...]]:
    """Name, role, residuals in metres and the root mean square of the marks, of each point in a report."""
    found = []
    for role, names in (("control", "control"), ("checkpoint", "checkpoints"), ("left out", "left_out")):
        for name in facts[names]:
            marks = np.array(list(facts["marks_px"].get(name, {}).values())).reshape(-1, 2)
            pixels = f"{np.sqrt((marks**2).sum(1).mean()):.2f} of {len(marks)}" if len(marks) else ""
            found.append((name, role, *(f"{value:+.3f}" for value in facts["residuals_m"][name]), pixels))
    return found


def draw_points(axes: Any, where: ControlResiduals, width: float) -> None:
    """Draw points as symbols in a picture from above, and their residuals as arrows, so many times too long as the
    legend says.

    Args:
        axes: Of matplotlib, in units of the map.
        where: The points.
        width: Of the picture, units of the map.
    """
    names = [name for name in where.residuals if name in where.places]
    if not names:
        return
    left = np.array([where.residuals[name][:2] for name in names]) / where.chart.metres
    good = [at for at, name in enumerate(names) if name not in where.wrong]
    longest = float(np.linalg.norm(left[good or slice(None)], axis=1).max())
    times = _rounded(ARROW_SHARE * width / max(longest, 1e-9))
    places = np.array([where.places[name][:2] for name in names])
    for role, (symbol, colour) in SYMBOLS.items():
        rows = [at for at, name in enumerate(names) if where.role(name) == role]
        if rows:
            what = {"control": "control points", "checkpoint": "checkpoints", "left out": "points left out"}[role]
            edge = dict(facecolors="none" if symbol != "X" else colour, edgecolors=colour)
            axes.scatter(*places[rows].T, marker=symbol, s=40, zorder=3, label=f"{len(rows)} {what}", **edge)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.003, "color": "black"}
    axes.quiver(*places[good].T, *(times * left[good]).T, zorder=4, **arrows)
    axes.plot([], [], color="black", linewidth=1.5, label=f"residual in plan, {times:g} times")
    for name, at in zip(names, places, strict=True):
        axes.annotate(name, at, xytext=(4, 4), textcoords="offset points", fontsize=7)


def _rounded(value: float) -> float:
    """1, 2 or 5 times a power of ten, at most a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step for step in (5, 2, 1) if step * power <= value) * power
