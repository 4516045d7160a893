"""What became of each photograph, and how well all fits: report.json, and cameras and points from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.sfm.control_report import draw_points
from surfkit.apps.sfm.feature_cache import MIN_FEATURES
from surfkit.apps.sfm.georeference import Placement, centres_of
from surfkit.apps.sfm.ground_control import ControlResiduals
from surfkit.apps.sfm.inspect_photos import MIN_MEAN_GREY, Photo, blurred_below
from surfkit.core.files import replacing

MAX_PICTURE_POINTS = 20_000
"""Points in the picture."""


def reasons(
    photos: Sequence[Photo], features: Mapping[str, int], matches: Mapping[str, int], models: Sequence[set[str]]
) -> dict[str, str]:
    """Why each photograph that is not in the first model is not, by name.

    Args:
        photos: All of the folder.
        features: How many each usable one has.
        matches: With how many others each shares matches.
        models: Names in each model.
    """
    found, blurred = {}, blurred_below(photos)
    for photo in photos:
        name = photo.name
        if models and name in models[0]:
            continue
        sight = " (far less sharp than the others)" if photo.usable and photo.sharpness < blurred else ""
        sight = " (dark)" if photo.usable and photo.light < MIN_MEAN_GREY else sight
        group = next((number for number, names in enumerate(models) if name in names), None)
        if photo.problem is not None:
            found[name] = photo.problem
        elif group is not None:
            found[name] = f"in another group of photographs, without matches to the largest: sparse/{group}"
        elif features.get(name, 0) < MIN_FEATURES:
            found[name] = f"{features.get(name, 0)} features, {MIN_FEATURES} are needed{sight}"
        elif not matches.get(name):
            found[name] = f"matches no other photograph{sight}"
        else:
            found[name] = f"matches {matches[name]} photographs, but too few points or none that fit{sight}"
    return found


def model_facts(model: Any, placement: Placement | ControlResiduals | None) -> dict[str, Any]:
    """Figures of a model, and its residuals on the map."""
    facts: dict[str, Any] = {
        "photographs": model.num_reg_images(),
        "points": model.num_points3D(),
        "observations_per_photograph": round(model.compute_mean_observations_per_reg_image(), 1),
        "track_length": round(model.compute_mean_track_length(), 2),
        "reprojection_error_px": round(model.compute_mean_reprojection_error(), 3),
        "cameras": [
            {
                "model": camera.model.name,
                "size": [camera.width, camera.height],
                "params": list(map(float, camera.params)),
            }
            for _, camera in sorted(model.cameras.items())
        ],
    }
    if isinstance(placement, ControlResiduals):
        facts["ground_control"] = placement.facts()
    elif placement is not None:
        facts["georeference"] = georeference_facts(model, placement)
    return facts


def georeference_facts(model: Any, placement: Placement) -> dict[str, Any]:
    """Residuals of the positions of a model on the map, metres: position less camera. Heights have none where the
    positions have no altitudes."""
    centres, metres = centres_of(model), placement.chart.metres
    left = np.stack([(xyz - centres[name]) * metres for name, xyz in zip(placement.names, placement.onto, strict=True)])
    inside = placement.fit.inside
    lengths = np.linalg.norm(left, axis=1)
    rms = dict(zip("enu", np.sqrt((left[inside] ** 2).mean(0)).round(3).tolist(), strict=True))
    return {
        "crs": placement.chart.crs,
        "offset": list(placement.chart.offset),
        "positions": int(inside.sum()),
        "heights": "above the middle of the ground" if placement.plan else "of the positions",
        "rms_m": rms | {"u": None} if placement.plan else rms,
        "median_m": round(float(np.median(lengths[inside])), 3),
        "left_out": {
            name: round(float(length), 1)
            for name, length, good in zip(placement.names, lengths, inside, strict=True)
            if not good
        },
        "residuals_m": {name: row for name, row in zip(placement.names, left.round(3).tolist(), strict=True)},
    }


def draw(path: Path, model: Any, placement: Placement | ControlResiduals | None) -> None:
    """A picture of cameras and points from above; of positions too, with a line to the camera of each, or
    of control points with their residuals."""
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    points = sorted(model.points3D.items())
    points = points[:: max(1, len(points) // MAX_PICTURE_POINTS)]
    xyz = np.array([point.xyz for _, point in points]).reshape(-1, 3)
    rgb = np.array([point.color for _, point in points], np.float64).reshape(-1, 3) / 255
    centres = centres_of(model)
    cameras = np.stack(list(centres.values()))
    near = _box(xyz, cameras)
    figure = Figure(figsize=(9, 9.5))
    axes = figure.add_subplot()
    axes.scatter(xyz[:, 0], xyz[:, 1], c=rgb, s=1.5, linewidths=0, rasterized=True)
    if isinstance(placement, Placement):
        onto = placement.onto
        lines = [(centres[name][:2], to[:2]) for name, to in zip(placement.names, onto, strict=True)]
        colours = ["tab:orange" if good else "red" for good in placement.fit.inside]
        axes.add_collection(LineCollection(lines, colors=colours, linewidths=0.8))
        axes.plot([], [], color="tab:orange", linewidth=0.8, label="to its position")
        if not placement.fit.inside.all():
            axes.plot([], [], color="red", linewidth=0.8, label="position left out")
    if isinstance(placement, ControlResiduals):
        draw_points(axes, placement, float(np.ptp(near, axis=0).max()))
    axes.scatter(cameras[:, 0], cameras[:, 1], marker="^", c="tab:blue", s=24, label=f"{len(cameras)} cameras")
    axes.set(xlim=near[:, 0], ylim=near[:, 1], aspect="equal", xlabel="x", ylabel="y", title="from above")
    if placement is not None:
        east, north, _ = placement.chart.offset
        axes.set(xlabel=f"east - {east:.0f}", ylabel=f"north - {north:.0f}", title=f"from above, {placement.chart.crs}")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=3)
    with replacing(path) as file:
        figure.savefig(file, format="png", dpi=110, bbox_inches="tight")


def _box(xyz: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """(2, 2) lower and upper corner of all cameras and most of the points, with a margin."""
    low, high = np.percentile(xyz[:, :2], [2, 98], axis=0)
    low, high = np.minimum(low, cameras[:, :2].min(0)), np.maximum(high, cameras[:, :2].max(0))
    margin = 0.05 * max(float((high - low).max()), 1e-9)
    return np.stack([low - margin, high + margin])
