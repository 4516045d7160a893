"""Normals of a surface at any place: of the faces of a mesh, from the file of a cloud, or of the points around."""

from __future__ import annotations

import numpy as np

from surfkit.evaluate.geometry.repetition import ComparedSurface
from surfkit.evaluate.geometry.sampling import sample_faces
from surfkit.evaluate.geometry.scores import WORKERS, nearest_rows, tree
from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS, SurfaceFile

MAX_ORIENTED_POINTS = 2_000_000
"""Points with normals among which the nearest is looked for."""
PLANE_NEIGHBOURS = 12
"""Points that a plane is fitted to, of a cloud thinned to half of tau: about tau around."""
NORMAL_FIELDS = ("nx", "ny", "nz")


def normals_at(side: ComparedSurface, places: np.ndarray, cloud: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    """(n, 3) unit normals of a surface near places; which of the two sides they point to is not known.

    Those of the nearest sample of a mesh, or of the nearest point of a cloud whose file has normals; else of the plane
    that fits the nearest points best.

    Args:
        side: The surface.
        places: (n, 3) its own frame.
        cloud: (m, 3) thinned points of it, its own frame.
        draw: Of the samples of a mesh.
    """
    if not len(places):
        return np.empty((0, 3))
    if side.surface.faces is not None:
        points, face = sample_faces(side.surface, min(side.count, MAX_ORIENTED_POINTS), draw)
        return _face_normals(side.surface, face[nearest_rows(tree(points), places)])
    if (known := _given(side.surface)) is not None:
        return known[1][nearest_rows(tree(known[0]), places)]
    return _fitted(cloud, places)


def _face_normals(mesh: SurfaceFile, faces: np.ndarray) -> np.ndarray:
    corners = mesh.vertices(np.asarray(mesh.triangles[faces]).ravel()).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-300)


def _given(cloud: SurfaceFile) -> tuple[np.ndarray, np.ndarray] | None:
    """(k, 3) points and (k, 3) unit normals from the file of a cloud, every so many; None without usable ones."""
    if not set(NORMAL_FIELDS) <= set(cloud.rows.dtype.names or ()):
        return None
    part = slice(None, None, max(1, -(-len(cloud) // MAX_ORIENTED_POINTS)))
    points, rows = cloud.vertices(part), cloud.rows[part]
    normals = np.stack([rows[name] for name in NORMAL_FIELDS], axis=1, dtype=np.float64)
    length = np.linalg.norm(normals, axis=1)
    good = np.isfinite(points).all(1) & np.isfinite(length) & (length > 1e-6)
    return (points[good], normals[good] / length[good, None]) if good.any() else None


def _fitted(cloud: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(n, 3) normals of planes through the nearest points of a cloud."""
    there, found = tree(cloud), np.empty((len(places), 3))
    step = BLOCK_POINTS // 8
    for start in range(0, len(places), step):
        part = slice(start, start + step)
        rows = there.query(places[part], k=min(PLANE_NEIGHBOURS, len(cloud)), workers=WORKERS)[1]
        near = cloud[rows] - cloud[rows].mean(1, keepdims=True)
        found[part] = np.linalg.eigh(near.transpose(0, 2, 1) @ near)[1][:, :, 0]
    return found
