"""How far a simplified mesh lies from the one that it stands for."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from surfkit.mesh.base import Mesh
from surfkit.mesh.holes import areas_of

SAMPLES = 100_000
"""Places on each of the two meshes."""
SHARE = 95.0
"""Percentage of the surface that lies nearer than what is given."""
PLASTIC = 1.324717957244746
"""Its first powers fill a square evenly (R2; Roberts 2018)."""


def level_error(fine: Mesh, coarse: Mesh) -> float:
    """Distance from a coarse mesh below which 95 % of a fine one lies, units of the meshes.

    Of places spread over the fine mesh, it is the distance from the plane of the nearest place on the coarse one, or
    that place itself less twice the distance between places, if that is more: where a part of it is missing.
    """
    if not len(fine.faces) or not len(coarse.faces):
        return 0.0
    places, _, _ = spread(fine)
    others, normals, apart = spread(coarse)
    away, at = cKDTree(others).query(places)
    across = np.abs(((places - others[at]) * normals[at]).sum(1))
    return float(np.percentile(np.maximum(across, away - 2 * apart), SHARE))


def spread(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, float]:
    """(S, 3) places spread evenly over a mesh, (S, 3) unit normals there, and about how far places are apart."""
    areas = areas_of(mesh.vertices, mesh.faces).astype(np.float64)
    ends = np.cumsum(areas)
    number = np.arange(SAMPLES)
    face = np.searchsorted(ends, (number + 0.5) / SAMPLES * ends[-1]).clip(max=len(areas) - 1)
    u, v = number / PLASTIC % 1, number / PLASTIC**2 % 1
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    a, b, c = mesh.vertices[mesh.faces[face]].astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), normals, float(np.sqrt(ends[-1] / SAMPLES))
