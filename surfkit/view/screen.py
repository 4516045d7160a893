"""Between a browser's camera, in the units of the page, and places and cameras of the local frame."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from surfkit.scene.camera import Camera
from surfkit.view.layers import WORLD

if TYPE_CHECKING:
    import viser


def ray_of(event: viser.SceneClickEvent) -> tuple[np.ndarray, np.ndarray]:
    """Origin and unit direction of a click, local frame."""
    direction = np.asarray(event.ray_direction, np.float64)
    return np.asarray(event.ray_origin, np.float64) / WORLD, direction / np.linalg.norm(direction)


def pose_of(camera: viser.CameraHandle) -> np.ndarray:
    """(4, 4) float64 world_to_camera of a browser's camera, local frame."""
    from viser import transforms

    turn = transforms.SO3(np.asarray(camera.wxyz, np.float64)).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ (np.asarray(camera.position, np.float64) / WORLD)
    return pose


def quaternion_of(pose: np.ndarray) -> np.ndarray:
    """(4,) wxyz of the rotation from the axes of a camera to the world."""
    from viser import transforms

    return transforms.SO3.from_matrix(np.asarray(pose[:3, :3], np.float64).T).wxyz


def stand_at(client: viser.ClientHandle, pose: np.ndarray, distance: float) -> None:
    """Move a browser's camera.

    Args:
        client: Whose.
        pose: (4, 4) world_to_camera, local frame.
        distance: Of the place about which the mouse turns then, local units.
    """
    turn, centre = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    with client.atomic():
        client.camera.position = centre * WORLD
        client.camera.look_at = (centre + distance * turn[2]) * WORLD
        client.camera.wxyz = quaternion_of(pose)


def whole_view(camera: Camera, aspect: float) -> float:
    """Vertical field of view, radians, of a window of width / height `aspect` in which all of a photograph is seen."""
    up = max(camera.cy, camera.height - camera.cy) / camera.fy
    side = max(camera.cx, camera.width - camera.cx) / camera.fx
    return 2 * math.atan(max(up, side / aspect))
