"""A picture of each class: its points coloured by error, the others grey."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from surfkit.core.events import FileWritten, emit
from surfkit.evaluate.geometry.classes import Classes, PointClassification
from surfkit.evaluate.geometry.comparison import ComparisonResult
from surfkit.evaluate.geometry.errors import PICTURE_LONGEST_PX, draw_from_view, error_colors, write_plan, write_row
from surfkit.evaluate.geometry.point_visibility import project
from surfkit.evaluate.geometry.transform import apply, scale_of
from surfkit.scene.scene import Frame, View

OTHER_COLOR = np.array([232, 232, 232], np.uint8)
"""Colour of points of other classes."""
DRAWN_FROM_VIEWS = {("surface", "facade"), ("edges", "near"), ("edges", "away")}
"""Classes that are drawn as a training view sees them: from above they are lines."""
CANDIDATE_VIEWS = 8
"""Training views of which the one with the most points of a class is drawn."""
CHOOSING_POINTS = 20_000
"""Points that decide which."""


def write_classes(
    out: Path, outcome: ComparisonResult, classes: Classes, views: Sequence[View] = (), frame: Frame | None = None
) -> None:
    """Write `class-GROUP-NAME.png` for each class that has points: both clouds, from above or as a view sees them.

    Args:
        out: Folder.
        outcome: Of the comparison.
        classes: Its points, told apart.
        views: Training views, perhaps none.
        frame: Of the views.
    """
    draw, tau = outcome.draws[0], outcome.tau
    colors = [error_colors(d, tau) for d in (draw.distances.to_truth, draw.distances.to_reconstruction)]
    for group in classes.groups:
        for number, name in enumerate(group.classes):
            chosen = group.ours == number, group.truth == number
            if not (chosen[0].any() or chosen[1].any()):
                continue
            captions = [f"{what}: {_caption(group, name)}" for what in ("reconstruction", "truth")]
            shown = [np.where(which[:, None], color, OTHER_COLOR) for which, color in zip(chosen, colors, strict=True)]
            path = out / f"class-{group.name}-{name.replace(' ', '-')}.png"
            parts = list(zip(captions, (draw.reconstruction, draw.truth), shown, strict=True))
            if (group.name, name) in DRAWN_FROM_VIEWS and views and frame is not None:
                _write_view(path, parts, outcome, chosen, (views, frame))
            else:
                write_plan(path, parts, outcome.crop, classes.up.axis, tau)
            emit(FileWritten(path, "geometry"))


def _caption(group: PointClassification, name: str) -> str:
    """What a class is, under a picture."""
    texts = {
        "surface": name,
        "views": f"seen by {name} views",
        "edges": "near edges of the depth" if name == "near" else "away from edges of the depth",
        "seams": "near borders of blocks" if name == "near" else "away from borders of blocks",
    }
    return f"{texts[group.name]}, blue right, orange to red wrong or missing"


def _write_view(
    path: Path,
    parts: list[tuple[str, np.ndarray, np.ndarray]],
    outcome: ComparisonResult,
    chosen: tuple[np.ndarray, np.ndarray],
    scene: tuple[Sequence[View], Frame],
) -> None:
    """Draw both clouds as the training view that has the most points of the class in its picture sees them."""
    views, frame = scene
    matrix = outcome.draws[0].alignment.matrix
    back, gap = np.linalg.inv(matrix), outcome.tau / scale_of(matrix)
    points = parts[1][1][chosen[1]] if chosen[1].any() else parts[0][1][chosen[0]]
    few = apply(back, points[:: max(1, len(points) // CHOOSING_POINTS)])
    count = min(CANDIDATE_VIEWS, len(views))
    some = [views[(2 * i + 1) * len(views) // (2 * count)].camera.sized(PICTURE_LONGEST_PX) for i in range(count)]
    camera = max(some, key=lambda one: len(project(few, one, frame.input_pose(one.world_to_camera))[0]))
    pose = frame.input_pose(camera.world_to_camera)
    images = [draw_from_view(camera, pose, apply(back, cloud), colors, gap) for _, cloud, colors in parts]
    write_row(path, [caption for caption, _, _ in parts], images)
