"""The geometry of a reconstruction, measured: figures for metrics.json, and files to look at."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.events import FileWritten, Warned, emit
from surfkit.evaluate.geometry.class_pictures import write_classes
from surfkit.evaluate.geometry.classes import class_figures, classify
from surfkit.evaluate.geometry.comparison import Comparison, ComparisonResult, compare
from surfkit.evaluate.geometry.errors import (
    PICTURE_LONGEST_PX,
    draw_from_view,
    error_colors,
    write_cloud,
    write_plan,
    write_row,
)
from surfkit.evaluate.geometry.file_transform import same_plan
from surfkit.evaluate.geometry.height_systems import HeightSystem
from surfkit.evaluate.geometry.line_plot import write_chart
from surfkit.evaluate.geometry.normal_fidelity import normal_angles, roughness_on_truth
from surfkit.evaluate.geometry.repetition import RepetitionResult
from surfkit.evaluate.geometry.scores import chamfer, curve, shares
from surfkit.evaluate.geometry.surface_file import read_surface, system_of
from surfkit.evaluate.geometry.transform import apply, scale_of, write_transform
from surfkit.evaluate.images.seams import Seams
from surfkit.evaluate.mesh.measure_mesh import measure_mesh
from surfkit.scene.crop import write_crop
from surfkit.scene.scene import Frame, View

CURVE_TAUS = 5
"""Multiples of tau that the curve covers."""
CHAMFER_CUTOFF_TAUS = 20.0
"""Multiples of tau above which distances do not count in the chamfer distance of DTU, by default."""
DRAWN_VIEWS = 3
"""Views that are drawn."""
SCORE_NAMES = ("precision", "recall", "f1")


def measure_geometry(
    files: tuple[Path, Path],
    settings: Comparison,
    out: Path,
    views: Sequence[View] = (),
    frame: Frame | None = None,
    seams: Seams | None = None,
) -> dict[str, Any]:
    """Compare a mesh or cloud with the truth, write what there is to look at into a folder, and return the figures:
    "geometry" against the truth, and of a mesh "mesh", what is measured of it alone.

    Args:
        files: The reconstruction and the truth.
        settings: How.
        out: Gets crop.json, transform.txt, precision.ply, recall.ply, curve.png, plan.png and pictures of a few views
            and of each class.
        views: Training views; without any, the crop volume must be given.
        frame: Of the views.
        seams: Borders of blocks, to tell the places near them apart.

    Raises:
        BadInput: A file that cannot be used, or two that do not belong together.
    """
    reconstruction, truth = map(read_surface, files)
    if settings.transform is None and frame is not None:
        warn_of_other_system(files[1], frame)
    metres = None if frame is None else frame.metres
    alone = None if reconstruction.faces is None else measure_mesh(reconstruction, metres)
    outcome = compare(reconstruction, truth, settings, views, frame)
    found = figures(outcome, settings) | {"reconstruction": str(files[0]), "truth": str(files[1])}
    if alone is not None:
        found["normals"] = normal_angles(outcome, np.random.default_rng(settings.seed))
        found["roughness"] = roughness_on_truth(outcome, alone.roughness, alone.metres or 1.0)
    for left in (*out.glob("view[0-9].png"), *out.glob("class-*.png")):  # of an earlier comparison
        left.unlink()
    write_files(out, outcome, settings)
    if frame is not None:
        write_views(out, outcome, views, frame)
    if settings.classes:
        classes = classify(outcome, settings, views, frame, seams)
        found["classes"] = class_figures(classes, outcome.draws[0], outcome.tau)
        write_classes(out, outcome, classes, views, frame)
    return {"geometry": found} | ({} if alone is None else {"mesh": alone.figures})


def warn_of_other_system(truth: Path, frame: Frame) -> None:
    """Warn if the truth names another coordinate reference system than the photographs, in plan or of heights."""
    theirs = system_of(truth)
    if frame.crs is None:
        return
    if theirs is not None and not same_plan(theirs, frame.crs):
        emit(Warned(f"{truth}: its coordinates are in {theirs}, and those of the photographs in {frame.crs}"))
    ours, heights = HeightSystem.of(frame.crs), HeightSystem.of(theirs, truth)
    if why := ours.contradicts(heights) or ours.leaves_open(heights):
        emit(Warned(f"{truth}: {why} (here: the photographs)"))


def figures(outcome: ComparisonResult, settings: Comparison) -> dict[str, Any]:
    """Plain data: precision, recall and F1 with standard deviations, chamfer distances, alignments."""
    tau = outcome.tau
    each = [dict(zip(SCORE_NAMES, shares(draw.distances, tau), strict=True)) for draw in outcome.draws]
    means = {name: statistics.fmean(draw[name] for draw in each) for name in SCORE_NAMES}
    spread = {f"{name}_std": statistics.stdev(d[name] for d in each) if len(each) > 1 else None for name in SCORE_NAMES}
    first, far = outcome.draws[0], settings.far or CHAMFER_CUTOFF_TAUS * tau
    taus = np.linspace(0, CURVE_TAUS * tau, 4 * CURVE_TAUS + 1)
    precision, recall = curve(first.distances, taus).T.tolist()
    crop = outcome.crop
    return {
        **means,
        **spread,
        "preset": settings.preset,
        "tau": tau,
        "tau_from": "given" if settings.tau else "spacing of the truth",
        "align": settings.align,
        "draws": each,
        "alignments": {way: draw and _alignment(draw, outcome) for way, draw in outcome.others.items()},
        "chamfer": chamfer(first.distances),
        "chamfer_dtu": {**chamfer(first.distances, far), "far": far},
        "points": {"reconstruction": len(first.reconstruction), "truth": len(first.truth)},
        "crop": crop and {"from": settings.crop, "low": crop.low, "high": crop.high, "area": crop.area},
        "area": outcome.area and outcome.area.record(),
        "outside": outcome.outside,
        "truth_voxel": outcome.voxel,
        "seen_points": outcome.seen,
        "curve": {"tau": taus.tolist(), "precision": precision, "recall": recall},
    }


def _alignment(draw: RepetitionResult, outcome: ComparisonResult) -> dict[str, Any]:
    """One way of aligning: what it changed, how well it fits, and what it gives."""
    found = draw.alignment
    change = found.matrix @ np.linalg.inv(outcome.matrix)
    turn = change[:3, :3] / scale_of(change)
    middle = draw.truth.mean(0)
    return {
        "scale": scale_of(change),
        "moved": float(np.linalg.norm(apply(change, middle[None])[0] - middle)),
        "turned_degrees": float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))),
        "residual": found.residual,
        "matched": found.matched,
        **dict(zip(SCORE_NAMES, shares(draw.distances, outcome.tau), strict=True)),
        "matrix": found.matrix.tolist(),
    }


def write_files(out: Path, outcome: ComparisonResult, settings: Comparison) -> None:
    """Write the crop volume, the transform, both clouds coloured by error, the curve and the plan."""
    draw, tau = outcome.draws[0], outcome.tau
    if outcome.crop is not None:
        write_crop(out / "crop.json", outcome.crop)
    write_transform(out / "transform.txt", draw.alignment.matrix)
    write_cloud(out / "precision.ply", draw.reconstruction, draw.distances.to_truth, tau)
    write_cloud(out / "recall.ply", draw.truth, draw.distances.to_reconstruction, tau)
    taus = np.linspace(0, CURVE_TAUS * tau, 201)
    precision, recall, f1 = shares(draw.distances, tau)
    title = f"precision {precision:.3f}, recall {recall:.3f}, F1 {f1:.3f} at tau = {tau:.3g}"
    write_chart(out / "curve.png", taus, curve(draw.distances, taus), tau, title)
    write_plan(out / "plan.png", _parts(draw, tau), outcome.crop, settings.up or "z", tau)
    for name in ("precision.ply", "recall.ply", "curve.png", "plan.png"):
        emit(FileWritten(out / name, "geometry"))


def _parts(draw: RepetitionResult, tau: float) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Both clouds with captions and colours."""
    captions = (
        f"reconstruction: blue within {tau:.3g} of the truth, orange to red wrong",
        f"truth: blue within {tau:.3g} of the reconstruction, orange to red missing",
    )
    clouds = (draw.reconstruction, draw.truth)
    distances = (draw.distances.to_truth, draw.distances.to_reconstruction)
    return [(c, p, error_colors(d, tau)) for c, p, d in zip(captions, clouds, distances, strict=True)]


def write_views(out: Path, outcome: ComparisonResult, views: Sequence[View], frame: Frame) -> None:
    """Draw both clouds, coloured by error, as a few of the training views see them."""
    draw, tau = outcome.draws[0], outcome.tau
    back = np.linalg.inv(draw.alignment.matrix)
    for i in range(min(DRAWN_VIEWS, len(views))):
        view = views[(2 * i + 1) * len(views) // (2 * min(DRAWN_VIEWS, len(views)))]
        camera = view.camera.sized(PICTURE_LONGEST_PX)
        pose = frame.input_pose(camera.world_to_camera)
        gap = tau / scale_of(draw.alignment.matrix)
        parts = _parts(draw, tau)
        images = [draw_from_view(camera, pose, apply(back, points), colors, gap) for _, points, colors in parts]
        path = out / f"view{i}.png"
        write_row(path, [caption for caption, _, _ in parts], images)
        emit(FileWritten(path, "geometry"))
