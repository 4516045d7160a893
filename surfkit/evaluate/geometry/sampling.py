"""Points on a mesh, spread evenly and the same for the same seed."""

from __future__ import annotations

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS, SurfaceFile

R2_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""Of the R2 sequence: 1 / g and 1 / g^2 with g^3 = g + 1. Its points keep their distance however many there are."""


def sample_surface(mesh: SurfaceFile, count: int, draw: np.random.Generator) -> np.ndarray:
    """(count, 3) float64 points on a mesh, as many on each part as its area has a share in the whole, to within one.

    The area is cut into `count` equal strips in the order of the faces, and one point falls into each; within a face
    the points follow a low-discrepancy sequence with a random start. Much more even than independent draws, so fewer
    points tell as much.

    Raises:
        BadInput: The faces have no area.
    """
    return sample_faces(mesh, count, draw)[0]


def sample_faces(mesh: SurfaceFile, count: int, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The points of `sample_surface`, and (count,) the face that each lies on."""
    ends = np.cumsum(face_areas(mesh))
    if not ends[-1] > 0:
        raise BadInput(f"{mesh.path}: its faces have no area, so there is no surface to measure; make the mesh again")
    at = (np.arange(count) + draw.random(count)) * (ends[-1] / count)
    face = np.searchsorted(ends, at, "right").clip(max=len(ends) - 1)
    used, first, size = np.unique(face, return_index=True, return_counts=True)
    shift = np.repeat(draw.random((len(used), 2)), size, axis=0)
    order = np.arange(count) - np.repeat(first, size)
    points = np.empty((count, 3))
    for start in range(0, count, BLOCK_POINTS):
        part = slice(start, start + BLOCK_POINTS)
        spot = (shift[part] + order[part, None] * R2_STEPS) % 1
        spot = np.where(spot.sum(1, keepdims=True) > 1, 1 - spot, spot)
        corners = mesh.vertices(mesh.triangles[face[part]].ravel()).reshape(-1, 3, 3)
        sides = corners[:, 1:] - corners[:, :1]
        points[part] = corners[:, 0] + (spot[:, :, None] * sides).sum(1)
    return points, face


def face_areas(mesh: SurfaceFile) -> np.ndarray:
    """(F,) areas of the triangles of a mesh, float64."""
    areas = np.empty(len(mesh.triangles))
    for start in range(0, len(areas), BLOCK_POINTS):
        corners = mesh.vertices(np.asarray(mesh.triangles[start : start + BLOCK_POINTS]).ravel()).reshape(-1, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas[start : start + BLOCK_POINTS] = np.linalg.norm(normals, axis=1) / 2
    return areas
