"""Camera positions and ground control: residuals in tables and on the map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.quality.document import Element, Figure, Paragraph, Section, Table
from surfkit.apps.quality.figures import as_map, bounds_about, drawing, finished, round_length, styled
from surfkit.apps.quality.sections.words import fixed, moments
from surfkit.apps.quality.survey import Survey
from surfkit.apps.report.json_values import mapping, number, texts, value_at
from surfkit.apps.sfm.control_list import GroundControlPoint, read_list
from surfkit.apps.sfm.dataset_export import file_name
from surfkit.core.check import BadInput
from surfkit.io.datasets.crs_names import system_of

ARROW_SHARE = 0.08
"""Of the larger side of a map: about the longest arrow."""
AXES = ("x (east)", "y (north)", "z (up)")


def positions(survey: Survey) -> Section:
    """Positions of the photographs by GPS or a file, against the adjusted cameras."""
    told = survey.georeference
    residuals = residual_rows(told)
    elements: list[Element] = []
    if not residuals:
        elements.append(Paragraph(_without_residuals(survey), "missing"))
        elements.append(positions_figure(survey, {}, False))
        return Section("Camera positions", tuple(elements))
    left_out = set(mapping(told, "left_out"))
    with_heights = value_at(told, "rms_m", "u") is not None
    used = np.array([row for name, row in residuals.items() if name not in left_out]).reshape(-1, 3)
    elements.append(positions_figure(survey, residuals, with_heights))
    rows = []
    for name, values in zip(("mean", "standard deviation σ", "RMS"), moments(used), strict=True):
        shown = [fixed(value, 3) for value in values]
        rows.append((name, *shown[:2], shown[2] if with_heights else fixed(None, 3)))
    note = f"Position less adjusted camera, metres, of {len(used)} positions that agree"
    note += "." if with_heights else "; heights have none, as the positions have no altitudes."
    elements.append(Table("Residuals of the positions, m", ("", *AXES), tuple(rows), note))
    if left_out:
        listed = tuple((name, fixed(float(mapping(told, "left_out")[name]), 1)) for name in sorted(left_out))
        elements.append(
            Table("Positions left out", ("photograph", "distance, m"), listed, "They contradict the others.")
        )
    return Section("Camera positions", tuple(elements))


def _without_residuals(survey: Survey) -> str:
    """Why no residuals of the positions are known."""
    if not survey.ground_control:
        return (
            "No positions of the photographs are known: surfkit prepare photos takes them from EXIF and XMP, or from a "
            "file, --positions FILE."
        )
    adjustment = mapping(survey.ground_control, "adjustment")
    count = number(adjustment, "positions")
    if not count or not adjustment.get("kept"):
        return "The scene was placed by ground control points; positions of the photographs were not used."
    said = (
        f"The scene was placed by ground control points. Positions of {count:.0f} photographs are part of its "
        "adjustment too; their residuals are not kept."
    )
    offset = adjustment.get("positions_offset_m")
    if isinstance(offset, list) and len(offset) == 3:
        said += f" They differ from the control points by {' '.join(f'{value:+.2f}' for value in offset)} m on average"
        said += " (east, north, up), which was taken away."
    return said


def residual_rows(told: dict[str, Any]) -> dict[str, np.ndarray]:
    """(3,) residuals in metres by name, of those that are three numbers."""
    found = {}
    for name, row in mapping(told, "residuals_m").items():
        values = np.array(row if isinstance(row, list) else [], dtype=object)
        if values.shape == (3,) and all(isinstance(value, (int, float)) for value in values):
            found[name] = values.astype(np.float64)
    return found


def positions_figure(survey: Survey, residuals: dict[str, np.ndarray], with_heights: bool) -> Figure:
    """Cameras from above, with arrows to their positions."""
    centres = {view.name: xyz for view, xyz in zip(survey.views, survey.centres, strict=True)}
    names = [name for name in residuals if file_name(name) in centres]
    rows = np.array([residuals[name] for name in names]).reshape(-1, 3)
    metres = survey.scene.frame.metres or 1.0
    with styled():
        canvas, axes = drawing(0.82, 0.85)
        bounds = bounds_about(survey.centres[:, :2], 0.12)
        axes.plot(*survey.centres[:, :2].T, "^", color="#57606a", markersize=3, label="camera", zorder=3)
        note = f"{len(survey.views)} cameras from above."
        if len(names):
            places = np.array([centres[file_name(name)] for name in names])
            times = exaggeration(rows[:, :2] / metres, bounds)
            arrows = axes.quiver(
                places[:, 0], places[:, 1], *(times * rows[:, :2] / metres).T, *([rows[:, 2]] if with_heights else []),
                angles="xy", scale_units="xy", scale=1, width=0.003, cmap="coolwarm", zorder=4,
            )  # fmt: skip
            if with_heights:
                most = max(float(np.abs(rows[:, 2]).max()), 1e-9)
                arrows.set_clim(-most, most)
                canvas.colorbar(arrows, ax=axes, label="residual in z, m", shrink=0.7)
            note += f" Arrows from camera to position, in plan, {times:g} times as long as they are."
        as_map(axes, bounds, survey.unit, survey.scene.frame.crs is not None)
        title = "Camera positions and their residuals" if names else "Cameras from above"
        return finished(canvas, title, 0.82, note)


def exaggeration(plan: np.ndarray, bounds: tuple[float, float, float, float]) -> float:
    """How many times as long (N, 2) residuals are drawn on a map, for the long ones to be well seen."""
    lengths = np.linalg.norm(plan, axis=1)
    longest = float(np.percentile(lengths, 90)) if len(lengths) else 0.0
    return (
        round_length(ARROW_SHARE * max(bounds[2] - bounds[0], bounds[3] - bounds[1]) / longest) if longest > 0 else 1.0
    )


def control(survey: Survey) -> Section:
    """Control and check points, each with its residuals."""
    told = survey.ground_control
    residuals = residual_rows(told)
    if not residuals:
        text = (
            "No ground control points were used, so nothing checks the position of the map independently. "
            "surfkit prepare photos --gcp FILE takes them, and --checkpoints N holds some back to check the others."
        )
        return Section("Control and check points", (Paragraph(text, "missing"),))
    listed, why = listed_points(survey)
    checks, wrong = set(texts(told, "checkpoints")), set(texts(told, "left_out"))
    rows = []
    for name, values in residuals.items():
        kind = "check" if name in checks else "left out" if name in wrong else "control"
        marks = mark_lengths(told, name)
        seen = (str(len(marks)), fixed(float(np.sqrt(np.mean(marks**2))), 2)) if len(marks) else (fixed(None, 0),) * 2
        rows.append((name, kind, *(fixed(value, 3) for value in (*values, np.linalg.norm(values))), *seen))
    head = ("point", "kind", *AXES, "3D", "photographs", "marks, RMS px")
    elements: list[Element] = [
        Table("Residuals, m", head, tuple(rows), "Surveyed coordinates less those of the model.")
    ]
    sums = []
    for kind, names in (("control", texts(told, "control")), ("check", texts(told, "checkpoints"))):
        known = np.array([residuals[name] for name in names if name in residuals and name not in wrong]).reshape(-1, 3)
        for name, values in (
            zip(("mean", "standard deviation σ", "RMS"), moments(known), strict=True) if len(known) else ()
        ):
            sums.append((f"{kind}, {name}", *(fixed(value, 3) for value in values), str(len(known))))
    elements.append(Table("Control and check points, m", ("", *AXES, "points"), tuple(sums)))
    if bad := [mark for mark in told.get("wrong_marks") or () if isinstance(mark, dict)]:
        listed_marks = tuple((str(mark.get("point")), str(mark.get("photograph")), _pixels(mark)) for mark in bad)
        elements.append(
            Table("Marks left out", ("point", "photograph", "off by, px"), listed_marks, "They contradict the others.")
        )
    if unseen := texts(told, "in_too_few_photographs"):
        elements.append(Paragraph(f"In too few photographs to be used: {', '.join(unseen)}.", "warning"))
    if why:
        elements.append(Paragraph(why, "missing"))
    if places := {name: np.array(listed[name].xyz) for name in residuals if name in listed}:
        elements.append(control_figure(survey, places, residuals, checks, wrong))
    return Section("Control and check points", tuple(elements))


def mark_lengths(told: dict[str, Any], point: str) -> np.ndarray:
    """(M,) pixels by which the marks of a point in photographs lie off, those left out not among them."""
    wrong = {(mark.get("point"), mark.get("photograph")) for mark in told.get("wrong_marks") or ()}
    rows = [row for name, row in mapping(told, "marks_px", point).items() if (point, name) not in wrong]
    return np.linalg.norm(np.array(rows, np.float64).reshape(-1, 2), axis=1)


def _pixels(mark: dict[str, Any]) -> str:
    value = mark.get("pixels")
    return fixed(float(value) if isinstance(value, (int, float)) else None, 1)


def listed_points(survey: Survey) -> tuple[dict[str, GroundControlPoint], str]:
    """The points of the list that was used, by name, and why there are none."""
    path = value_at(survey.prepared, "settings", "gcp")
    if not isinstance(path, str):
        return {}, "The list of the points is not known, so there is no picture of where they are."
    try:
        crs, points = read_list(Path(path))
        if system_of(crs).degrees:
            return {}, "The list of the points is in degrees, so there is no picture of where they are."
    except BadInput as error:
        return {}, f"There is no picture of where they are: {error}."
    return {point.name: point for point in points}, ""


def control_figure(
    survey: Survey, places: dict[str, np.ndarray], residuals: dict[str, np.ndarray], checks: set[str], wrong: set[str]
) -> Figure:
    """Where the points are, with arrows of their residuals in plan."""
    names = list(places)
    xy = np.array([places[name][:2] for name in names])
    metres = survey.scene.frame.metres or 1.0
    plan = np.array([residuals[name][:2] for name in names]) / metres
    with styled():
        canvas, axes = drawing(0.82, 0.85)
        bounds = bounds_about(np.concatenate([xy, survey.centres[:, :2]]), 0.08)
        axes.plot(*survey.centres[:, :2].T, "^", color="#c3cad1", markersize=2.5, label="camera")
        for kind, sign, colour, chosen in (
            ("control", "o", "#0b57a4", [name not in checks | wrong for name in names]),
            ("check", "s", "#b85a00", [name in checks for name in names]),
            ("left out", "x", "#b3202c", [name in wrong for name in names]),
        ):
            if any(chosen):
                axes.plot(*xy[chosen].T, sign, color=colour, markersize=5, linestyle="", label=kind)
        times = exaggeration(plan, bounds)
        axes.quiver(*xy.T, *(times * plan).T, angles="xy", scale_units="xy", scale=1, width=0.003, zorder=4)
        for name, place in zip(names, xy, strict=True):
            axes.annotate(name, place, (4, 4), textcoords="offset points")
        as_map(axes, bounds, survey.unit, survey.scene.frame.crs is not None)
        axes.legend(loc="upper left")
        note = f"Arrows: surveyed less model, in plan, {times:g} times as long as they are."
        return finished(canvas, "Control and check points", 0.82, note)


def accuracy_rows(survey: Survey) -> Sequence[tuple[str, ...]]:
    """Rows of the table of accuracy on the first page: what, how many, RMS in x, y and z in metres."""
    rows = []
    for name, key in (("control points", "control"), ("check points", "checkpoints")):
        rms = mapping(survey.ground_control, f"{key}_rms_m")
        if rms:
            rows.append((name, str(len(texts(survey.ground_control, key))), *_axes_of(rms)))
    if rms := mapping(survey.georeference, "rms_m"):
        rows.append(("positions of the photographs", str(survey.georeference.get("positions", "")), *_axes_of(rms)))
    return rows


def _axes_of(rms: dict[str, Any]) -> tuple[str, ...]:
    return tuple(fixed(rms.get(axis), 3) for axis in "enu")
