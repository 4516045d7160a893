"""What a photograph shows of each triangle of a mesh: how much, in which colour, and whether something is in front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from surfkit.mesh.base import Mesh
from surfkit.mesh.depths import nearest
from surfkit.raster.native import kernels, module
from surfkit.scene.camera import Camera
from surfkit.scene.one_light import sensor_places

HIDDEN_SLACK_PX = 2.0
"""How far a triangle may lie behind the nearest surface and be seen, in sides of a pixel at its depth."""
OUTLINE_PX, MIN_OUTLINE_STEP_PX = 2, 12.0
"""A triangle within so many pixels of the outline of something in front of it, by so many sides of a pixel, may show
the colour of that: meshes and cameras are not exact."""
EDGE_QUALITY = 0.1
"""What the quality of such a triangle is multiplied by."""
BATCH_TRIANGLE_PIXELS = 1 << 21
"""Pairs of a triangle and a pixel in memory, without the compiled kernels."""


@dataclass(frozen=True)
class TriangleVisibility:
    """The triangles that a photograph shows whole.

    Attributes:
        faces: (n,) their rows in the mesh, rising.
        quality: (n,) float32 pixels that they take, times the cosine between the ray and the normal.
        color: (n, 3) uint8 mean colours.
        place: (n, 2) where on the sensor they lie, see `sensor_places`.
    """

    faces: np.ndarray
    quality: np.ndarray
    color: np.ndarray
    place: np.ndarray


def project(vertices: np.ndarray, camera: Camera) -> np.ndarray:
    """(V, 3) float32 x and y in pixels, and depth, of (V, 3) places; x and y mean nothing behind the camera."""
    pose = camera.world_to_camera.numpy()
    local = vertices @ pose[:3, :3].T.astype(np.float64) + pose[:3, 3]
    z = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.stack([local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy, z], 1)
    return found.astype(np.float32)


def sight(
    mesh: Mesh, camera: Camera, photo: np.ndarray, keep: np.ndarray | None = None, longest: float = np.inf
) -> TriangleVisibility:
    """What a photograph shows of a mesh.

    Args:
        mesh: The mesh.
        camera: Of the photograph.
        photo: (3, H, W) uint8.
        keep: (H, W) bool, false where the photograph is to be ignored; None for all of it.
        longest: Triangles that are wider or higher than this, in pixels, are left out.
    """
    places = project(mesh.vertices, camera)
    depth = nearest(mesh.vertices, mesh.faces, camera)
    if keep is not None:
        depth[~keep] = 0
    focal = min(camera.fx, camera.fy)
    covered, hidden, sums = look(places, mesh.faces, photo, depth, HIDDEN_SLACK_PX / focal)
    rows = np.flatnonzero((covered > 0) & (hidden == 0))
    rows = rows[np.ptp(places[mesh.faces[rows], :2], axis=1).max(1) <= longest]
    corners = places[mesh.faces[rows]]
    near = ndimage.minimum_filter(depth, 2 * OUTLINE_PX + 1)
    _, at_edge, _ = look(places, mesh.faces[rows], photo, near, MIN_OUTLINE_STEP_PX / focal)
    (ax, ay), (bx, by) = (corners[:, i, :2].T - corners[:, 0, :2].T for i in (1, 2))
    area = np.abs(ax * by - ay * bx) / 2
    quality = area * _cosine(mesh, camera, rows) * np.where(at_edge > 0, EDGE_QUALITY, 1.0)
    color = np.rint(sums[rows] / covered[rows, None]).astype(np.uint8)
    place = sensor_places(camera, *corners[:, :, :2].mean(1).T)
    return TriangleVisibility(rows, np.maximum(quality, 1e-6).astype(np.float32), color, place)


def _cosine(mesh: Mesh, camera: Camera, rows: np.ndarray) -> np.ndarray:
    """(n,) cosines between the normals of some triangles and the rays to them, without sign."""
    corners = mesh.vertices[mesh.faces[rows]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rays = corners.mean(1) - camera.centre.numpy()
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    return np.abs((normals * rays).sum(1)) / np.maximum(lengths, 1e-30)


def look(
    places: np.ndarray, faces: np.ndarray, photo: np.ndarray, depth: np.ndarray, slack: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels that triangles cover, (F,) int32, 0 for those that do not lie in the picture; of these, the ones on which
    something is nearer; (F, 3) float32 sums of the colours of the others.

    A triangle between the centres of pixels is looked at where its middle is.

    Args:
        places: (V, 3) x and y in pixels, and depth.
        faces: (F, 3).
        photo: (3, H, W) uint8.
        depth: (H, W) float32 of the nearest surface.
        slack: Share of its depth by which a place may lie behind that and be seen.
    """
    count = len(faces)
    covered, hidden, sums = np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros((count, 3), np.float32)
    places, faces = np.ascontiguousarray(places, np.float32), np.ascontiguousarray(faces, np.int32)
    photo, depth = np.ascontiguousarray(photo), np.ascontiguousarray(depth, np.float32)
    if module() is None:
        look_in_numpy(places, faces, photo, depth, slack, (covered, hidden, sums))
    else:
        kernels().look(places, faces, depth, photo, slack, covered, hidden, sums, torch.get_num_threads())
    return covered, hidden, sums


def look_in_numpy(
    places: np.ndarray,
    faces: np.ndarray,
    photo: np.ndarray,
    depth: np.ndarray,
    slack: float,
    into: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """The same by numpy, many pairs of a triangle and a pixel in its box at once."""
    height, width = depth.shape
    corners = places[faces].astype(np.float64)
    x, y, z = (corners[:, :, i] for i in range(3))
    with np.errstate(invalid="ignore"):
        inside = ((z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)).all(1)
    rows = np.flatnonzero(inside)
    low = np.ceil(corners[rows, :, :2].min(1) - 0.5).clip(0).astype(np.int64)
    high = (np.floor(corners[rows, :, :2].max(1) - 0.5) + 1).clip(low, [width, height]).astype(np.int64)
    ends = np.cumsum((high - low).prod(1))
    first = 0
    while first < len(rows):
        last = max(
            first + 1, int(np.searchsorted(ends, (ends[first - 1] if first else 0) + BATCH_TRIANGLE_PIXELS, "right"))
        )
        part = slice(first, last)
        _look_at_some(corners[rows[part]], rows[part], (low[part], high[part]), photo, depth, slack, into)
        first = last


def _look_at_some(
    corners: np.ndarray,
    rows: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
    photo: np.ndarray,
    depth: np.ndarray,
    slack: float,
    into: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Count the pixels of triangles whose boxes of pixels are given."""
    low, high = box
    count, wide = (high - low).prod(1), high[:, 0] - low[:, 0]
    owner = np.repeat(np.arange(len(rows)), count)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    row = within // wide[owner]
    column = within - row * wide[owner] + low[owner, 0]
    row += low[owner, 1]
    inverse = 1 / corners[:, :, 2]
    ahead, across = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    area = ahead[:, 0] * across[:, 1] - across[:, 0] * ahead[:, 1]
    px, py = column + 0.5 - corners[owner, 0, 0], row + 0.5 - corners[owner, 0, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        b = (px * across[owner, 1] - across[owner, 0] * py) / area[owner]
        c = (ahead[owner, 0] * py - px * ahead[owner, 1]) / area[owner]
        hit = (b >= 0) & (c >= 0) & (b + c <= 1)
        slopes = inverse[:, 1:] - inverse[:, :1]
        z = 1 / (inverse[owner, 0] + b * slopes[owner, 0] + c * slopes[owner, 1])
    owner, row, column, z = owner[hit], row[hit], column[hit], z[hit]
    between = np.flatnonzero(np.bincount(owner, minlength=len(rows)) == 0)
    middle = corners[between].mean(1)
    owner = np.concatenate([owner, between])
    row, column = np.concatenate([[row, column], middle[:, 1::-1].T], axis=1).astype(np.int64)
    z = np.concatenate([z, 1 / inverse[between].mean(1)]).astype(np.float32)
    behind = z > depth[row, column] * np.float32(1 + np.float32(slack))
    covered, hidden, sums = into
    covered[rows] = np.bincount(owner, minlength=len(rows))
    hidden[rows] = np.bincount(owner[behind], minlength=len(rows))
    seen = ~behind
    for channel in range(3):
        shown = photo[channel, row[seen], column[seen]]
        sums[rows, channel] = np.bincount(owner[seen], shown, minlength=len(rows))
