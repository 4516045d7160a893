"""Pieces of a mesh: a photograph of a large scene shows few of them, and only these are looked at."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from surfkit.apps.texture.regions import divide, middles
from surfkit.mesh.base import Mesh
from surfkit.scene.camera import Camera

MAX_PIECE_TRIANGLES = 1 << 14
"""Triangles of a piece, at most."""
PIECE_MARGIN_PX = 1.0
"""Pieces within so much of the picture are taken: places in it are rounded."""


class MeshClusters:
    """A mesh in pieces that lie close together.

    Args:
        mesh: The mesh, with one triangle or more.
    """

    def __init__(self, mesh: Mesh) -> None:
        where = middles(mesh)
        number = divide(where, np.ones(len(where)), MAX_PIECE_TRIANGLES).of(where)
        order = np.argsort(number, kind="stable")
        starts = np.flatnonzero(np.diff(number[order], prepend=-1))
        corners = mesh.vertices[mesh.faces[order]]
        ends = np.minimum.reduceat(corners.min(1), starts), np.maximum.reduceat(corners.max(1), starts)
        self.mesh = mesh
        self.rows = np.split(order, starts[1:])
        self.boxes = box_corners(*ends)

    def in_view(self, camera: Camera) -> tuple[Mesh, np.ndarray]:
        """The pieces that may lie in a picture, as a mesh, and (n,) rows of its triangles in the whole one, rising."""
        outside = ~may_show(self.boxes, camera)
        if not outside.any():
            return self.mesh, np.arange(len(self.mesh.faces))
        rows = np.concatenate([np.empty(0, np.int64), *(self.rows[at] for at in np.flatnonzero(~outside))])
        rows.sort()
        faces = self.mesh.faces[rows]
        used = np.zeros(len(self.mesh.vertices), bool)
        used[faces] = True
        number = np.cumsum(used, dtype=np.int32) - 1
        colors = None if self.mesh.colors is None else self.mesh.colors[used]
        return replace(
            self.mesh, vertices=self.mesh.vertices[used], faces=number[faces].astype(np.int32), colors=colors
        ), rows


def may_show(boxes: np.ndarray, camera: Camera) -> np.ndarray:
    """(P,) bool whether something within boxes, whose (P, 8, 3) corners are given, may lie in a picture."""
    pose = camera.world_to_camera.numpy()
    x, y, z = np.moveaxis(boxes @ pose[:3, :3].T.astype(np.float64) + pose[:3, 3], 2, 0)
    left, right = (
        camera.fx * x + (camera.cx + side) * z for side in (PIECE_MARGIN_PX, -camera.width - PIECE_MARGIN_PX)
    )
    top, bottom = (
        camera.fy * y + (camera.cy + side) * z for side in (PIECE_MARGIN_PX, -camera.height - PIECE_MARGIN_PX)
    )
    return ~np.any([(side <= 0).all(1) for side in (z, left, -right, top, -bottom)], axis=0)


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(P, 8, 3) corners of boxes with (P, 3) least and greatest coordinates."""
    sides = np.array(list(product((0, 1), repeat=3)))
    return np.stack([low, high])[sides, :, np.arange(3)].transpose(2, 0, 1)
