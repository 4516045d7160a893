"""Precision, recall and F1 of parts of a surface: what is wrong where, and so what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from surfkit.evaluate.geometry.comparison import Comparison, ComparisonResult
from surfkit.evaluate.geometry.repetition import MIN_COMPARED_POINTS, RepetitionResult
from surfkit.evaluate.geometry.scores import nearest_rows, surface_gap, tree
from surfkit.evaluate.geometry.sightings import Sightings, sightings
from surfkit.evaluate.geometry.surface_normals import normals_at
from surfkit.evaluate.geometry.terrain import Terrain, terrain
from surfkit.evaluate.geometry.thinning import thin
from surfkit.evaluate.geometry.transform import apply, scale_of
from surfkit.evaluate.images.seams import Seams
from surfkit.scene.scene import Frame, View
from surfkit.scene.up_direction import Up, up_direction

REACH_TAUS = 5.0
"""Multiples of tau within which a point of the reconstruction has the class of the nearest point of the truth."""
FOR_VIEWS = 400_000
"""Points of the truth that views are counted for, about; larger clouds are thinned to that, and the nearest counts."""
LEVEL_COSINE = 0.5
"""Cosine between up and a normal, above which a surface is a roof or ground: up to 60 degrees steep."""
NO_CLASS = -1
"""Class of a point that belongs to none."""
SURFACE_CLASSES = ("roof", "facade", "ground")
VIEW_CLASSES = ("0", "1", "2", "3-5", "6 or more")
SEEN_FROM = (0, 1, 2, 3, 6)
"""Views that a point of each class is seen by, or more."""
EDGE_CLASSES = ("near", "away")
SEAM_CLASSES = ("near", "elsewhere")


@dataclass(frozen=True)
class PointClassification:
    """One way to tell points apart.

    Attributes:
        name: What they are told apart by: surface, views, edges or seams.
        classes: Names.
        ours: (n,) int8 class of each point of the reconstruction, -1 for none.
        truth: (m,) int8 class of each point of the truth.
    """

    name: str
    classes: tuple[str, ...]
    ours: np.ndarray
    truth: np.ndarray


@dataclass(frozen=True)
class Classes:
    """The points of the first repetition of a comparison, told apart.

    Attributes:
        groups: In the order in which they are shown.
        up: Which way is up, and who said so.
        ground: Of the truth; None where none of it faces up.
        seams: Near borders of blocks, or None.
    """

    groups: tuple[PointClassification, ...]
    up: Up
    ground: Terrain | None
    seams: Seams | None


def classify(
    outcome: ComparisonResult,
    settings: Comparison,
    views: Sequence[View] = (),
    frame: Frame | None = None,
    seams: Seams | None = None,
) -> Classes:
    """Tell the points of the first repetition apart.

    - surface: `facade` where the normal is more than 60 degrees from up; else `ground` up to a clearance above the
      local ground, `roof` above. Normals are those of faces, of the file of a cloud, or of planes fitted to the points
      around. Which side a surface faces does not count, as files differ in it.
    - views: training views that see the place, as the crop volume counts them.
    - edges: `near` where the place lies within 4 pixels (of a picture 800 pixels long) of a step in depth in at least
      half of the views that see it; places that no view sees are in neither class.
    - seams: `near` borders of blocks, or `elsewhere`.

    A point of the truth has its own class. One of the reconstruction has that of the nearest point of the truth within
    5 tau; where there is none, its own: by its normal, by the views that see it past the truth, by its place.

    Args:
        outcome: Of the comparison.
        settings: Of the comparison.
        views: Training views; without any, only surfaces are told apart.
        frame: Of the views.
        seams: Borders of blocks.
    """
    draw, tau = outcome.draws[0], outcome.tau
    back = np.linalg.inv(draw.alignment.matrix)
    near = draw.distances.to_truth <= REACH_TAUS * tau
    partner = np.full(len(draw.reconstruction), NO_CLASS)
    partner[near] = nearest_rows(tree(draw.truth), draw.reconstruction[near])
    far = np.flatnonzero(~near)
    up = up_direction(settings.up, views, frame, draw.alignment.matrix)
    surface, ground = _surfaces(outcome, up, partner, far, np.random.default_rng(settings.seed))
    groups = [surface]
    if frame is not None and len(views):
        groups += _by_views(draw, (views, frame), partner, far, tau)
    if frame is not None and seams is not None:
        groups.append(_by_seams(draw, back, frame, seams))
    return Classes(tuple(groups), up, ground, seams)


def _reconstruction_classes(truth: np.ndarray, own: np.ndarray, partner: np.ndarray, far: np.ndarray) -> np.ndarray:
    """(n,) int8 classes of the reconstruction, from those of the truth, and its own where it is far from that."""
    found = truth[partner]  # of the last row where there is no partner; put right below
    found[far] = own
    return found


def _surfaces(
    outcome: ComparisonResult, up: Up, partner: np.ndarray, far: np.ndarray, random: np.random.Generator
) -> tuple[PointClassification, Terrain | None]:
    draw = outcome.draws[0]
    ours, theirs = outcome.sides
    matrix = draw.alignment.matrix
    level = np.abs(normals_at(theirs, draw.truth, draw.truth, random) @ up.direction) > LEVEL_COSINE
    ground = terrain(draw.truth[level], up.turn, outcome.tau) if level.any() else None
    places = draw.reconstruction[far]
    back = np.linalg.inv(matrix)
    normals = normals_at(ours, apply(back, places), apply(back, draw.reconstruction), random)
    own_level = np.abs(normals @ (matrix[:3, :3] / scale_of(matrix)).T @ up.direction) > LEVEL_COSINE
    truth, own = _named(draw.truth, level, ground), _named(places, own_level, ground)
    return PointClassification(
        "surface", SURFACE_CLASSES, _reconstruction_classes(truth, own, partner, far), truth
    ), ground


def _named(points: np.ndarray, level: np.ndarray, ground: Terrain | None) -> np.ndarray:
    """(n,) int8 classes of points whose surface is level, or not."""
    roof, facade, low = range(3)
    if ground is None:
        return np.where(level, NO_CLASS, facade).astype(np.int8)
    high = ground.above(points) > ground.clearance
    return np.where(~level, facade, np.where(high, roof, low)).astype(np.int8)


def _by_views(
    draw: RepetitionResult, scene: tuple[Sequence[View], Frame], partner: np.ndarray, far: np.ndarray, tau: float
) -> list[PointClassification]:
    back, fewer = np.linalg.inv(draw.alignment.matrix), draw.truth
    if len(fewer) > FOR_VIEWS:
        fewer = thin([fewer], tau / 2 * np.sqrt(len(fewer) / FOR_VIEWS), fewer[0])
    there = tree(fewer)
    gap = surface_gap(there, fewer[:: max(1, len(fewer) // 100_000)]) / scale_of(draw.alignment.matrix)
    own_places = apply(back, draw.reconstruction[far])
    coarse, own_found = sightings((apply(back, fewer), own_places), *scene, gap)
    rows = nearest_rows(there, draw.truth)
    found = Sightings(coarse.seen[rows], coarse.edges[rows]), own_found

    def by_number(of: Sightings) -> np.ndarray:
        return (np.searchsorted(SEEN_FROM, of.seen, "right") - 1).astype(np.int8)

    def by_edge(of: Sightings) -> np.ndarray:
        near = 2 * of.edges >= of.seen
        return np.where(of.seen == 0, NO_CLASS, np.where(near, 0, 1)).astype(np.int8)

    groups = []
    for name, classes, class_of in (("views", VIEW_CLASSES, by_number), ("edges", EDGE_CLASSES, by_edge)):
        truth, own = map(class_of, found)
        groups.append(PointClassification(name, classes, _reconstruction_classes(truth, own, partner, far), truth))
    return groups


def _by_seams(draw: RepetitionResult, back: np.ndarray, frame: Frame, seams: Seams) -> PointClassification:
    ours, truth = (
        np.where(seams.near(frame.to_local(apply(back, points))), 0, 1).astype(np.int8)
        for points in (draw.reconstruction, draw.truth)
    )
    return PointClassification("seams", SEAM_CLASSES, ours, truth)


def class_figures(classes: Classes, draw: RepetitionResult, tau: float) -> dict[str, Any]:
    """Plain data: precision, recall and F1 of each class, and the points that these are shares of.

    A figure of fewer than 10 points is None.
    """
    ground, seams = classes.ground, classes.seams
    return {
        "up": classes.up.direction.tolist(),
        "up_from": classes.up.source,
        "reach": REACH_TAUS * tau,
        "ground": ground and {"cell": ground.cell, "clearance": ground.clearance},
        **({"seams_distance": seams.distance} if seams else {}),
        **{
            group.name: {name: _figures(group, number, draw, tau) for number, name in enumerate(group.classes)}
            for group in classes.groups
        },
    }


def _figures(group: PointClassification, number: int, draw: RepetitionResult, tau: float) -> dict[str, Any]:
    right = (draw.distances.to_truth < tau)[group.ours == number]
    there = (draw.distances.to_reconstruction < tau)[group.truth == number]
    precision, recall = (float(part.mean()) if len(part) >= MIN_COMPARED_POINTS else None for part in (right, there))
    f1 = None
    if precision is not None and recall is not None:
        f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    points = {"reconstruction": len(right), "truth": len(there)}
    return {"precision": precision, "recall": recall, "f1": f1, "points": points}
