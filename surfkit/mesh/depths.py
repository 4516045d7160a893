"""Depth maps of a mesh, exact but for the size of a pixel."""

from __future__ import annotations

import numpy as np

from surfkit.mesh.shade import draw_faces
from surfkit.scene.camera import Camera

NEAR_DEPTH_SHARE = 1e-5
"""Depth at which triangles are cut, as a share of the depth of the farthest corner in front of the camera."""


def mesh_depth(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) float32 camera z of the nearest triangle at each pixel centre, 0 where there is none.

    Triangles that reach behind the camera are cut where they pass it.

    Args:
        vertices: (V, 3) float64 local frame.
        faces: (F, 3).
        camera: Lens, size and pose.
    """
    depth = nearest(vertices, faces, camera)
    return np.where(np.isfinite(depth), depth, np.float32(0))


def nearest(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """The same, inf where there is no triangle."""
    pose = camera.world_to_camera.numpy()
    local = vertices @ pose[:3, :3].T.astype(np.float64) + pose[:3, 3]
    near = NEAR_DEPTH_SHARE * max(float(local[:, 2].max(initial=0)), 1e-12)
    local, faces = in_front(local, faces, near)
    z = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    places = np.stack([local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy, z], 1)
    places[np.isnan(z), 2] = 0.0
    return draw_faces(places, faces, camera.width, camera.height)[0]


def in_front(local: np.ndarray, faces: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the part of a mesh with a depth of `near` or more.

    Args:
        local: (V, 3) in the frame of the camera.
        faces: (F, 3).
        near: Depth of the cut.
    """
    ahead = (local[:, 2] >= near)[faces]
    count = ahead.sum(1)
    if (count == 3).all():
        return local, faces
    vertices, kept = [local], [np.asarray(faces[count == 3], np.int64)]
    begun = len(local)
    for corners in (1, 2):
        rows = np.asarray(faces[count == corners], np.int64)
        if not len(rows):
            continue
        single = np.argmax(ahead[count == corners] == (corners == 1), axis=1)  # the corner alone on its side
        a, b, c = (rows[np.arange(len(rows)), (single + turn) % 3] for turn in (0, 1, 2))
        cuts = [_cut(local[a], local[b], near), _cut(local[a], local[c], near)]
        ab, ac = (begun + side * len(rows) + np.arange(len(rows)) for side in (0, 1))
        vertices += cuts
        begun += 2 * len(rows)
        kept += [np.stack([a, ab, ac], 1)] if corners == 1 else [np.stack([ab, b, c], 1), np.stack([ab, c, ac], 1)]
    return np.concatenate(vertices), np.concatenate(kept)


def _cut(one: np.ndarray, other: np.ndarray, near: float) -> np.ndarray:
    """(n, 3) where the lines between points of either side pass the depth."""
    share = (near - one[:, 2:]) / (other[:, 2:] - one[:, 2:])
    found = one + share * (other - one)
    found[:, 2] = near
    return found
