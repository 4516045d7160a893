"""Between a browser and the local frame: its camera, its clicks, and what its user asks for."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.scene.camera import Camera

if TYPE_CHECKING:
    import viser

WORLD = 10.0
"""Units of the page per local unit: keys move the camera by two units of the page a second."""
REST_S = 0.4
"""A slider or a camera that has not moved for so long is at rest."""


class Latest:
    """Does what was asked for last, after a moment of rest: sliders send each place that they pass."""

    def __init__(self, action: Callable[[], None]) -> None:
        """Do `action`."""
        self.action, self.asked = action, 0

    def __call__(self, _event: Any = None) -> None:
        """Ask for it, and do it here if nobody asks again."""
        self.asked += 1
        mine = self.asked
        time.sleep(REST_S)
        if mine == self.asked:
            self.action()


def telling(client: viser.ClientHandle, action: Callable[..., None]) -> Callable[[Any], None]:
    """A callback that shows what a user can correct as a note on the page."""

    def guarded(event: Any) -> None:
        try:
            action(event)
        except (BadInput, OSError) as error:
            client.add_notification("That did not work", " ".join(str(error).split()), color="red")

    return guarded


def ray_of(event: viser.SceneClickEvent) -> tuple[np.ndarray, np.ndarray]:
    """Origin and unit direction of a click, local frame."""
    direction = np.asarray(event.ray_direction, np.float64)
    return np.asarray(event.ray_origin, np.float64) / WORLD, direction / np.linalg.norm(direction)


def ray_through(camera: viser.CameraHandle, x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Origin and unit direction of the ray of a pixel of a browser, local frame.

    Args:
        camera: Of the browser.
        x: From the middle of the window to the right, in halves of its height.
        y: Downwards.
    """
    pose, half = pose_of(camera), math.tan(camera.fov / 2)
    direction = pose[:3, :3].T @ [x * half, y * half, 1.0]
    return -pose[:3, :3].T @ pose[:3, 3], direction / np.linalg.norm(direction)


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
