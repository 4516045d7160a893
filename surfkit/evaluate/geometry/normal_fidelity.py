"""What a mesh does to the look of the truth: angles between their normals, and roughness where the truth is plane."""

from __future__ import annotations

from typing import Any

import numpy as np

from surfkit.evaluate.geometry.comparison import ComparisonResult
from surfkit.evaluate.geometry.repetition import MIN_COMPARED_POINTS
from surfkit.evaluate.geometry.scores import nearest_rows, tree
from surfkit.evaluate.geometry.surface_normals import normals_at
from surfkit.evaluate.geometry.transform import apply, scale_of
from surfkit.evaluate.mesh.roughness import Roughness, median_of, residuals

MAX_COMPARED_NORMALS = 200_000
"""Points at which normals are compared."""
MAX_PLANE_ROUGHNESS = 0.02
"""Roughness of the truth, in radii, up to which it is a plane."""


def normal_angles(outcome: ComparisonResult, draw: np.random.Generator) -> dict[str, Any]:
    """Plain data: median and 90 % quantile of the angle between the normals of a mesh and those of the truth, degrees.

    At the points of the mesh that are right (nearer than tau), against the nearest point of the truth: elsewhere there
    is no surface whose normal could be meant. Which side a surface faces does not count, as files differ in it.

    Args:
        outcome: Of the comparison of a mesh.
        draw: Of the samples of meshes, whose faces have the normals.
    """
    first, (ours, theirs) = outcome.draws[0], outcome.sides
    right = np.flatnonzero(first.distances.to_truth < outcome.tau)
    right = right[:: max(1, -(-len(right) // MAX_COMPARED_NORMALS))]
    found: dict[str, Any] = {"median": None, "p90": None, "points": len(right)}
    if len(right) < MIN_COMPARED_POINTS:
        return found
    places, matrix = first.reconstruction[right], first.alignment.matrix
    partners = first.truth[nearest_rows(tree(first.truth), places)]
    back = np.linalg.inv(matrix)
    own = normals_at(ours, apply(back, places), apply(back, first.reconstruction), draw)
    own = own @ (matrix[:3, :3] / scale_of(matrix)).T
    true = normals_at(theirs, partners, first.truth, draw)
    angles = np.degrees(np.arccos(np.abs((own * true).sum(1)).clip(max=1)))
    median, most = np.percentile(angles, [50, 90])
    return found | {"median": float(median), "p90": float(most)}


def roughness_on_truth(outcome: ComparisonResult, rough: Roughness, unit: float = 1.0) -> dict[str, Any]:
    """Plain data: roughness of a mesh at those of its places where the truth is a plane.

    The truth, thinned as it is compared, is a plane there if its own roughness in the same ball is at most a fiftieth
    of the radius, and goes through the ball at half of its radius. None where fewer than 10 such places are known.

    Args:
        outcome: Of the comparison.
        rough: Of the mesh, in the frame of the reconstruction.
        unit: What lengths of the reconstruction are multiplied by.
    """
    first = outcome.draws[0]
    matrix = first.alignment.matrix
    places, radius = apply(matrix, rough.places), rough.radius * scale_of(matrix)
    near = tree(first.truth).query(places, distance_upper_bound=radius / 2)[0] < np.inf
    even = np.flatnonzero(near)
    even = even[residuals(first.truth, places[even], radius) <= MAX_PLANE_ROUGHNESS * radius]
    value = median_of(rough.values[even]) if len(even) >= MIN_COMPARED_POINTS else None
    return {"on_truth_planes": value and value * unit, "places": len(even), "radius": rough.radius * unit}
