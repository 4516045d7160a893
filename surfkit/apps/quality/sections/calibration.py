"""The calibration of each camera, and how exact it is."""

from __future__ import annotations

from typing import Any

import numpy as np

from surfkit.apps.quality.covariance import CalibrationPrecision, calibration_precision
from surfkit.apps.quality.document import Element, Figure, Paragraph, Section, Table, facts
from surfkit.apps.quality.figures import drawing, finished, styled
from surfkit.apps.quality.sections.words import fixed
from surfkit.apps.quality.survey import Survey
from surfkit.apps.report.json_values import number, value_at
from surfkit.core.events import Progress, emit

FULL_FRAME_MM = 36.0
"""Longer side of the picture to which focal lengths in millimetres are equivalent."""
CURVE_POINTS = 100
"""Of the curve of radial distortion."""


def calibration(survey: Survey) -> Section:
    """All cameras."""
    model = survey.tie_points
    if model is None:
        text = (
            f"The layout of the data set {survey.data.path.name} keeps no observations of tie points, so standard "
            "deviations of the calibration cannot be computed; a COLMAP model, or surfkit prepare photos, has them."
        )
        return Section("Camera calibration", (Paragraph(text, "missing"), *_of_views(survey)))
    elements: list[Element] = []
    if survey.calibrated is None:
        text = (
            "Cameras are those of the data set as it is, with its own lens model; what its program adjusted is not "
            "known. Standard deviations are those of an adjustment of focal lengths and distortion to its tie points."
        )
        elements.append(Paragraph(text, "missing"))
    for at, (key, camera) in enumerate(model.cameras.items()):
        emit(Progress("calibration of cameras", at, len(model.cameras)))
        found = calibration_precision(model, key)
        count = int((model.camera_of == key).sum())
        elements += _camera(survey, at, camera, count, found, len(model.cameras) > 1)
    emit(Progress("calibration of cameras", len(model.cameras), len(model.cameras)))
    return Section("Camera calibration", tuple(elements))


def _camera(
    survey: Survey, at: int, camera: Any, count: int, found: CalibrationPrecision | None, several: bool
) -> list[Element]:
    title = f"Camera {at + 1}" if several else "Camera"
    rows = [
        ("lens model", camera.model.name),
        ("photographs", str(count)),
        ("size", f"{camera.width} x {camera.height} px"),
    ]
    if names := sorted({photo.exif.camera for photo in survey.photos if photo.exif.camera}):
        rows.insert(0, ("make and model in EXIF" + (", of all cameras" if several else ""), ", ".join(names)))
    equivalent = camera.mean_focal_length() * FULL_FRAME_MM / max(camera.width, camera.height)
    rows.append(("focal length", f"{camera.mean_focal_length():.2f} px, {equivalent:.2f} mm equivalent (36 mm wide)"))
    before = value_at(survey.model_facts, "weighed", "focal_lengths_px")
    if isinstance(before, list) and at < len(before) and (exif := number(before[at], "exif")) is not None:
        rows.append(("focal length in EXIF", f"{exif:.2f} px, {exif / camera.mean_focal_length() - 1:+.1%}"))
    elements: list[Element] = [facts(title, rows)]
    names = [name.strip() for name in camera.params_info.split(",")]
    places = {} if found is None else {index: row for row, index in enumerate(found.estimated)}
    shown = []
    for index, (name, value) in enumerate(zip(names, camera.params, strict=True)):
        in_px = index in (*camera.focal_length_idxs(), *camera.principal_point_idxs())
        sigma = "not adjusted" if index in camera.principal_point_idxs() else fixed(None, 0)
        if found is not None and index in places:
            deviation = found.deviations[places[index]]
            sigma = f"{deviation:.3f}" if in_px else f"{deviation:.1e}"
        shown.append((name, f"{value:.3f}" if in_px else f"{value:.3e}", "px" if in_px else "", sigma))
    elements.append(
        Table("Calibration", ("parameter", "value", "unit", "standard deviation"), tuple(shown), _note(found))
    )
    if found is not None and len(found.estimated) > 1:
        head = ("", *(names[index] for index in found.estimated))
        cells = found.correlations
        body = tuple((head[1 + row], *(f"{value:+.2f}" for value in cells[row])) for row in range(len(cells)))
        elements.append(Table("Correlations", head, body))
    elements.append(distortion_figure(camera))
    return elements


def _note(found: CalibrationPrecision | None) -> str:
    if found is None:
        return "The tie points do not determine the calibration: its normal matrix is singular."
    part = "all" if found.is_whole else "the most central"
    said = (
        f"Standard deviations from the normal matrix of the bundle adjustment of {part} {found.photos} photographs and "
        f"{found.observations:,} observations, tie points and poses eliminated, with the standard deviation of unit "
        f"weight {found.sigma:.3f} px of one coordinate. The focal length in EXIF and positions are not counted."
    )
    return said if found.is_whole else said + " The model is larger, so the real ones are smaller."


def _of_views(survey: Survey) -> list[Element]:
    """Cameras of a data set without observations, as they are used: undistorted."""
    sizes = sorted({(view.camera.width, view.camera.height, view.camera.fx, view.camera.fy) for view in survey.views})
    rows = tuple((f"{width} x {height}", fixed(fx, 2), fixed(fy, 2)) for width, height, fx, fy in sizes[:20])
    note = "At the size used; undistorted." + (f" The first 20 of {len(sizes)}." if len(sizes) > 20 else "")
    return [Table("Cameras as used", ("size, px", "fx, px", "fy, px"), rows, note)]


def radial_distortion(camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """(K,) radii of a pycolmap.Camera along the half diagonal, and by how much its lens moves them outwards, pixels.

    Of a fisheye, what is compared with is the equidistant projection.
    """
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    corner = np.array([camera.width, camera.height], np.float64) - middle
    radii = np.linspace(0, np.linalg.norm(corner), CURVE_POINTS + 1)[1:]
    spots = middle + radii[:, None] * corner / np.linalg.norm(corner)
    rays = np.linalg.norm(np.asarray(camera.cam_from_img(spots), np.float64).reshape(-1, 2), axis=1)
    ideal = np.arctan(rays) if "FISHEYE" in camera.model.name else rays
    return radii, radii - camera.mean_focal_length() * ideal


def distortion_figure(camera: Any) -> Figure:
    """The curve of radial distortion."""
    radii, moved = radial_distortion(camera)
    with styled():
        canvas, axes = drawing(0.6, 0.5)
        axes.axhline(0, color="#c3cad1", linewidth=0.6)
        axes.plot(radii, moved, color="#0b57a4", linewidth=1.2)
        axes.set(xlabel="distance from the principal point, px", ylabel="distortion, px", xlim=(0, radii[-1]))
        note = "Along the half diagonal; above 0 the lens moves image points outwards."
        if np.abs(np.nan_to_num(moved)).max() < 1e-6:
            axes.set(ylim=(-1, 1))
            note = "The cameras have no distortion: their photographs were undistorted before."
        return finished(canvas, "Radial distortion", 0.6, note)
