"""Fewer triangles of the same surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.mesh.base import Mesh
from surfkit.mesh.folds import unfolded
from surfkit.raster.native import kernels, lacking, module

COLLAPSE_COST_FACTOR = 6.0
"""What a collapse may cost, in squares of the length that is allowed: then 99 of 100 places stay within it."""


def require_kernels(what: str) -> None:
    """BadInput where surfkit was installed without the compiled kernels, which simplify meshes."""
    if module() is None:
        raise BadInput(f"{what} needs the compiled kernels: {lacking()}")


def simplified(mesh: Mesh, most: int | None = None, error: float | None = None) -> Mesh:
    """The mesh with fewer triangles, by collapsing edges, those first that move the surface least.

    Quadric error (Garland and Heckbert 1997) with the planes of open boundaries, weighted by area. An edge is collapsed
    only where the surface stays what it is: holes stay open, parts stay apart, no edge gets a third triangle, and no
    triangle turns over. A vertex gets the mean colour and values of those that it stands for. The result is the same
    every time. 17 million triangles take four minutes and 2 GB beside the mesh.

    Args:
        mesh: Any.
        most: Triangles that are wanted; more are left where no further edge can be collapsed.
        error: Local units by which the surface may move: of 100 places on it, about one moves farther, such as the tip
            of a thin triangle at a rim. None: as far as `most` asks for.

    Raises:
        BadInput: There are no compiled kernels.
    """
    require_kernels("simplifying a mesh")
    if not len(mesh.faces) or (error is None and (most is None or most >= len(mesh.faces))):
        return mesh
    vertices, faces, into = collapsed(mesh, most or 1, np.inf if error is None else COLLAPSE_COST_FACTOR * error**2)
    values = {name: _means(each, into, len(vertices)).astype(np.float32) for name, each in mesh.values.items()}
    colors = mesh.colors
    if colors is not None:
        means = [_means(channel, into, len(vertices)) for channel in colors.T]
        colors = np.stack([np.rint(each).astype(np.uint8) for each in means], axis=1)
    return replace(mesh, vertices=vertices, faces=faces, colors=colors, values=values)


def collapsed(
    mesh: Mesh, most: int, limit: float, fixed: np.ndarray | None = None, *, flat: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(V, 3) float32 vertices and (F, 3) int32 faces that are left, and which of these each vertex stands in; -1: none.

    Args:
        mesh: Any.
        most: See `simplified`.
        limit: Most that a collapse may cost: squared distances to planes, weighted by area in mean triangles.
        fixed: (V,) bool: vertices that stay as they are.
        flat: Whether all lies in a plane; where it is folded there, folds do not grow.
    """
    vertices, faces = np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.int32)
    fixed = np.zeros(len(vertices), np.uint8) if fixed is None else fixed.astype(np.uint8)
    return kernels().collapse(vertices, faces, max(1, most), limit, fixed, flat)


def _means(column: np.ndarray, into: np.ndarray, count: int) -> np.ndarray:
    """(count,) float64 means of the (V,) numbers that go to the same place, without what is not finite; NaN of none."""
    there = (into >= 0) & np.isfinite(column)
    at = into[there]
    with np.errstate(invalid="ignore"):
        return np.bincount(at, column[there], count) / np.bincount(at, minlength=count)


def require_simplification(what: str) -> None:
    """BadInput that says what to install, where the package that simplifies meshes cannot be loaded."""
    with needed("fast_simplification", what):
        import fast_simplification  # noqa: F401


def simplify_to(mesh: Mesh, count: int) -> Mesh:
    """The mesh with at most `count` triangles, by quadric error (Garland and Heckbert 1997, in fast-simplification).

    It is for meshes of any size: 10 million triangles take half a minute and 3 GB. A vertex gets the mean colour of
    those that it stands for. Where it lays triangles on one another, or makes edges of three, some are left out: see
    `unfolded`.

    Raises:
        BadInput: fast-simplification cannot be loaded.
    """
    if count >= len(mesh.faces):
        return mesh
    require_simplification("simplifying a mesh")
    from fast_simplification import simplify as reduced

    # its first limits are lengths: a thousandth of an edge
    unit = 1 / max(_mean_edge(mesh), 1e-30)
    middle = mesh.vertices.mean(0, dtype=np.float64)
    places, faces = reduced((mesh.vertices - middle) * unit, mesh.faces, target_count=count)
    used, corners = np.unique(faces, return_inverse=True)
    vertices = (places[used] / unit + middle).astype(np.float32)
    found = unfolded(Mesh(vertices, corners.reshape(-1, 3).astype(np.int32), facts=mesh.facts), mesh)
    if mesh.colors is None:
        return found
    return replace(found, colors=_mean_colors(mesh.vertices, mesh.colors, found.vertices))


def _mean_edge(mesh: Mesh) -> float:
    some = mesh.faces[:: max(1, len(mesh.faces) // 100_000)]
    return float(np.linalg.norm(mesh.vertices[some[:, 1]] - mesh.vertices[some[:, 0]], axis=1).mean())


def _mean_colors(before: np.ndarray, shades: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(V, 3) uint8 of fewer vertices: the mean of those before that are nearest to each, or of the next."""
    tree = KDTree(vertices)
    sums, counts = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for at in range(0, len(before), 1 << 20):
        part = slice(at, at + (1 << 20))
        nearest = tree.query(before[part], workers=-1)[1]
        counts += np.bincount(nearest, minlength=len(vertices))
        for channel in range(3):
            sums[:, channel] += np.bincount(nearest, shades[part, channel], len(vertices))
    known = counts > 0
    means = sums[known] / counts[known, None]
    colors = np.empty((len(vertices), 3), np.uint8)
    colors[known] = np.rint(means)
    if not known.all():
        colors[~known] = np.rint(means[KDTree(vertices[known]).query(vertices[~known])[1]])
    return colors
