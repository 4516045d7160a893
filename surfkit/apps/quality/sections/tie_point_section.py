"""Tie points: how many, in how many photographs, and how well they fit."""

from __future__ import annotations

import numpy as np

from surfkit.apps.quality.document import Element, Figure, Paragraph, Row, Section, Table, facts
from surfkit.apps.quality.figures import drawing, finished, histogram, round_length, styled
from surfkit.apps.quality.sections.residuals import residual_rows
from surfkit.apps.quality.sections.words import fixed
from surfkit.apps.quality.sparse_model import SparseModel
from surfkit.apps.quality.survey import Survey
from surfkit.apps.report.json_values import mapping, number

GRID = 16
"""Cells of the picture of residuals along the longer side of a photograph."""
MIN_CELL_OBSERVATIONS = 10
"""In a cell, for its mean residual to be drawn."""
MAX_LISTED = 500
"""Photographs in the table of the appendix."""
ERROR_BINS = 40
MAX_TRACK = 20
"""From so many photographs on, tie points are counted together."""


def tie_points(survey: Survey) -> Section:
    """Figures of all tie points, and the photographs that were not used."""
    model = survey.tie_points
    if model is None:
        text = "The data set keeps no observations of tie points: a COLMAP model, or surfkit prepare photos, has them."
        return Section("Tie points", (Paragraph(text, "missing"), *not_used(survey)))
    lengths, errors = model.track_lengths, model.errors
    seen = np.bincount(model.photo, minlength=len(model.names))
    rows = [
        ("tie points", f"{len(model.xyz):,}"),
        ("observations", f"{len(errors):,}"),
        ("photographs of a tie point", f"{lengths.mean():.2f} on average, {lengths.max()} at most"),
        ("reprojection error", f"mean {errors.mean():.3f} px, RMS {np.sqrt((errors**2).mean()):.3f} px"),
    ]
    if (mean := number(survey.model_facts, "reprojection_error_px")) is not None:
        rows.append(
            ("the same, mean of the means of tie points", f"{mean:.3f} px, as surfkit prepare photos prints it")
        )
    table = Table(
        "Per photograph",
        ("", "least", "median", "most"),
        (
            ("tie points", *(f"{value:,.0f}" for value in (seen.min(), np.median(seen), seen.max()))),
            ("mean reprojection error, px", *(fixed(v, 3) for v in np.nanpercentile(errors_of(model), [0, 50, 100]))),
        ),
    )
    most = float(np.percentile(errors, 99))
    tracks = histogram(
        lengths, np.arange(1.5, MAX_TRACK + 1), "Photographs of a tie point", f"photographs ({MAX_TRACK}: or more)",
        "tie points",
    )  # fmt: skip
    sizes = histogram(
        errors,
        np.linspace(0, most, ERROR_BINS),
        "Reprojection errors",
        f"error, px ({most:.1f}: or more)",
        "observations",
    )
    elements: list[Element] = [facts("All tie points", rows), table, Row((tracks, sizes))]
    if (place := residual_figure(model)) is not None:
        elements.append(place)
    if len(model.names) > MAX_LISTED:
        spread = histogram(seen, 40, "Tie points per photograph", "tie points", "photographs")
        elements.append(spread)
    return Section("Tie points", (*elements, *not_used(survey)))


def errors_of(model: SparseModel) -> np.ndarray:
    """(P,) mean reprojection error of each photograph, pixels; NaN for one without tie points."""
    counts = np.bincount(model.photo, minlength=len(model.names))
    sums = np.bincount(model.photo, model.errors, minlength=len(model.names))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def mean_residuals(model: SparseModel, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean residuals by place in the photographs of a camera: (H, W, 2) middles of cells and mean residuals, pixels,
    NaN where few are, and (H, W) how many there are."""
    camera = model.cameras[number]
    size = max(camera.width, camera.height) / GRID
    columns, rows = max(1, round(camera.width / size)), max(1, round(camera.height / size))
    mine = model.camera_of[model.photo] == number
    share = model.xy[mine] / (camera.width, camera.height)
    at = np.clip(np.floor(share * (columns, rows)).astype(int), 0, (columns - 1, rows - 1))
    cell = at[:, 1] * columns + at[:, 0]
    counts = np.bincount(cell, minlength=rows * columns)
    sums = np.stack([np.bincount(cell, model.residuals[mine, axis], minlength=rows * columns) for axis in (0, 1)], -1)
    means = np.where(counts[:, None] >= MIN_CELL_OBSERVATIONS, sums / np.maximum(counts, 1)[:, None], np.nan)
    x = (np.arange(columns) + 0.5) * camera.width / columns
    y = (np.arange(rows) + 0.5) * camera.height / rows
    middles = np.dstack(np.meshgrid(x, y))
    return middles, means.reshape(rows, columns, 2), counts.reshape(rows, columns)


def residual_figure(model: SparseModel) -> Figure | None:
    """Mean residuals by place in the photograph, of the camera with most photographs."""
    number = max(model.cameras, key=lambda key: int((model.camera_of == key).sum()))
    camera = model.cameras[number]
    middles, means, _ = mean_residuals(model, number)
    lengths = np.linalg.norm(means, axis=-1)
    known = np.isfinite(lengths)
    if not known.any():
        return None
    cell = camera.width / means.shape[1]
    times = round_length(cell / max(float(np.percentile(lengths[known], 95)), 1e-6))
    with styled():
        canvas, axes = drawing(0.75, camera.height / camera.width + 0.05)
        arrows = axes.quiver(
            *middles[known].T, *(times * means[known]).T, lengths[known], angles="xy", scale_units="xy", scale=1,
            width=0.003, cmap="viridis",
        )  # fmt: skip
        arrows.set_clim(0, float(lengths[known].max()))
        axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal", xlabel="x, px", ylabel="y, px")
        canvas.colorbar(arrows, ax=axes, label="mean residual, px", shrink=0.8)
        of = f"camera {list(model.cameras).index(number) + 1} ({int((model.camera_of == number).sum())} photographs)"
        note = (
            f"Observed less projected, mean of each cell, of {of}; {times:g} times as long as they are. A pattern, "
            "such as arrows to or from the middle, is an error of the lens model."
        )
        return finished(canvas, "Residuals by place in the photograph", 0.75, note)


def not_used(survey: Survey) -> list[Element]:
    """Photographs without a camera, and why."""
    why = mapping(survey.prepared, "not_registered")
    if not survey.prepared:
        text = "Which photographs have no camera is known of scenes that surfkit prepare photos made."
        return [Paragraph(text, "missing")]
    if not why:
        return [Paragraph("All photographs are used.")]
    rows = [(name, str(reason)) for name, reason in sorted(why.items())[:MAX_LISTED]]
    note = f"The first {MAX_LISTED} of {len(why)}." if len(why) > MAX_LISTED else ""
    return [facts("Photographs not used", rows, note)]


def appendix(survey: Survey) -> Section | None:
    """Tie points, errors and residuals of each photograph; None of more than `MAX_LISTED`, or without tie points."""
    model = survey.tie_points
    if model is None or len(model.names) > MAX_LISTED:
        return None
    seen, errors = np.bincount(model.photo, minlength=len(model.names)), errors_of(model)
    residuals = residual_rows(survey.georeference)
    rows = []
    for name, count, error in zip(model.names, seen, errors, strict=True):
        row = [name, f"{count:,}", fixed(float(error), 3)]
        if residuals:
            found = residuals.get(name)
            row += [fixed(None if found is None else float(found[axis]), 3) for axis in range(3)]
        rows.append(tuple(row))
    head = ["photograph", "tie points", "mean error, px"]
    head += ["x, m", "y, m", "z, m"] if residuals else []
    note = "x, y, z: position less adjusted camera." if residuals else ""
    return Section("Appendix: photographs", (Table("Each photograph", tuple(head), tuple(rows), note),))
