"""Which way is up, from how people and gimbals hold cameras: the horizon is level in a photograph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from surfkit.apps.sfm.inspect_photos import Photo

RIGHT_DIRECTIONS = {1: (1, 0), 2: (-1, 0), 3: (-1, 0), 4: (1, 0), 5: (0, 1), 6: (0, -1), 7: (0, -1), 8: (0, 1)}
"""By orientation in EXIF: where the right of the upright picture is, along x and y of the stored pixels."""
TOP_DIRECTIONS = {1: (0, -1), 2: (0, -1), 3: (0, 1), 4: (0, 1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""By orientation in EXIF: where its top is."""
MAX_PARALLEL_SINE_SQUARED = 0.02
"""Mean square of the sines between the right sides of photographs, below which they all point the same way."""


def up_direction(poses: np.ndarray, orientations: Sequence[int], points: np.ndarray) -> np.ndarray:
    """(3,) unit vector, world frame, that is most nearly at right angles to the right sides of all photographs.

    Where these all point the same way, as in strips without a turn, the thin direction of the points decides what is
    left open.

    Args:
        poses: (V, 4, 4) world_to_camera.
        orientations: (V,) of EXIF.
        points: (P, 3) world frame.
    """
    flat = np.array([(*RIGHT_DIRECTIONS[number], 0) for number in orientations], np.float64)
    tops = np.array([(*TOP_DIRECTIONS[number], 0) for number in orientations], np.float64)
    turns = poses[:, :3, :3]
    right = np.einsum("vji,vj->vi", turns, flat)
    above = np.einsum("vji,vj->vi", turns, tops) - turns[:, 2]  # against the view, for cameras that look down
    values, axes = np.linalg.eigh(right.T @ right / len(right))
    up = axes[:, 0]
    if values[1] < MAX_PARALLEL_SINE_SQUARED and len(points) > 3:
        away = points - np.median(points, axis=0)
        near = np.linalg.norm(away, axis=1) <= np.percentile(np.linalg.norm(away, axis=1), 90)
        thin = np.linalg.eigh(away[near].T @ away[near])[1][:, 0]
        within = axes[:, :2] @ (axes[:, :2].T @ thin)
        up = within / np.linalg.norm(within) if np.linalg.norm(within) > 0.1 else up
    return up if (above @ up).sum() >= 0 else -up


def turn_upright(up: np.ndarray) -> np.ndarray:
    """(3, 3) the smallest rotation that brings a unit vector to +z."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def up_of(model: Any, photos: Mapping[str, Photo]) -> np.ndarray:
    """(3,) unit vector of a pycolmap reconstruction, by how its cameras are held."""
    images = [model.image(number) for number in model.reg_image_ids()]
    return up_direction(poses_of(model), [photos[image.name].exif.orientation for image in images], points_of(model))


def poses_of(model: Any) -> np.ndarray:
    """(V, 4, 4) world_to_camera of the placed photographs of a pycolmap reconstruction."""
    images = [model.image(number) for number in model.reg_image_ids()]
    return np.stack([np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images])


def points_of(model: Any) -> np.ndarray:
    """(P, 3) points of a pycolmap reconstruction."""
    return np.array([point.xyz for point in model.points3D.values()], np.float64).reshape(-1, 3)
