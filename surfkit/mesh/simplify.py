"""Fewer triangles of the same surface."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np

from surfkit.core.optional import needed
from surfkit.mesh.base import Mesh


def require_open3d(what: str = "--lods") -> ModuleType:
    """Open3D, which `what` needs; BadInput that says what to install where it cannot be loaded."""
    with needed("open3d", what):
        import open3d
    return open3d


def simplify(mesh: Mesh, share: float) -> Mesh:
    """The mesh with about a share of its triangles, by quadric error (Garland and Heckbert 1997, in Open3D)."""
    open3d = require_open3d()
    whole = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)), open3d.utility.Vector3iVector(mesh.faces)
    )
    if mesh.colors is not None:
        whole.vertex_colors = open3d.utility.Vector3dVector(mesh.colors / 255.0)
    left = whole.simplify_quadric_decimation(max(1, round(share * len(mesh.faces))))
    left.remove_degenerate_triangles()
    left.remove_unreferenced_vertices()
    colors = None
    if mesh.colors is not None:
        colors = (np.asarray(left.vertex_colors).clip(0, 1) * 255).round().astype(np.uint8)
    vertices = np.asarray(left.vertices).astype(np.float32)
    return replace(mesh, vertices=vertices, faces=np.asarray(left.triangles).astype(np.int32), colors=colors)
