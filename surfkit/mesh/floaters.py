"""Loose parts of a surface that hang in what the views see through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from surfkit.mesh.base import Mesh
from surfkit.mesh.clean import clusters
from surfkit.mesh.lattice import FusionImage

TRIANGLES_PER_PART = 32
"""Triangles of a connected part whose middles are looked for in the views."""


def drop_floaters(mesh: Mesh, pictures: Iterator[FusionImage], reach: float, ratio: float) -> tuple[Mesh, int]:
    """The mesh without the connected parts that views see through more than they see them, and how many these were.

    However small, a part stays that enough views see: thin and small things are no floaters.

    Args:
        mesh: Local frame.
        pictures: What each view sees; pixels without weight are ignored.
        reach: A depth that differs by less than this from that of the part sees it, local units.
        ratio: A component is dropped if it is seen through more than this many times as often as it is seen.
    """
    labels, sizes = clusters(mesh)
    order = np.argsort(labels, kind="stable")
    first = np.cumsum(sizes) - sizes
    taken = np.minimum(sizes, TRIANGLES_PER_PART)
    part = np.repeat(np.arange(len(sizes)), taken)
    turn = np.arange(len(part)) - np.repeat(np.cumsum(taken) - taken, taken)
    points = mesh.vertices[mesh.faces[order[first[part] + turn * sizes[part] // taken[part]]]].mean(1, dtype=np.float64)
    seen, through = np.zeros(len(sizes)), np.zeros(len(sizes))
    for picture in pictures:
        at, beyond = _beyond(points, picture)
        seen += np.bincount(part[at], np.abs(beyond) <= reach, len(sizes))
        through += np.bincount(part[at], beyond > reach, len(sizes))
    stays = through <= ratio * seen
    return replace(mesh, faces=mesh.faces[stays[labels]]), int((~stays).sum())


def _beyond(points: np.ndarray, picture: FusionImage) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that fall on pixels which count, and by how much further these see."""
    camera = picture.camera
    x, y, z = camera.project(torch.from_numpy(points)).numpy().T
    inside = np.flatnonzero((z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
    rows, columns = y[inside].astype(np.int64), x[inside].astype(np.int64)
    depth = picture.depth[rows, columns]
    counts = (depth > 0) & (picture.shade[rows, columns] >> 24 > 0)
    return inside[counts], (depth - z[inside])[counts]
