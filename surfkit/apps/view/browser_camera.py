"""Between a browser and the local frame: its camera, its clicks, and what its user asks for."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch

from surfkit.apps.view.lod_selection import LodCamera
from surfkit.core.check import BadInput
from surfkit.scene.camera import Camera
from surfkit.scene.rotations import numpy_quaternions, numpy_rotations

if TYPE_CHECKING:
    import viser

T = TypeVar("T")
WORLD = 10.0
"""Units of the page per local unit: keys move the camera by two units of the page a second."""
REST_S = 0.3
"""A slider or a camera that has not moved for so long is at rest."""
TICK_S = 0.1
"""Between two looks at a camera that moves."""
BETWEEN_S = 1.0
"""From one choice to the next, at least, while the camera moves."""
FAR_MOVE_SHARE, FAR_DEGREES = 0.25, 15.0
"""A camera has moved far when it has gone this share of the way to what it turns about, or has turned by so much."""


class Debouncer:
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


class CameraFollower:
    """Looks where a camera is, in a thread of its own: while it moves, and when it has come to rest."""

    def __init__(self, action: Callable[[bool], None], rest: Callable[[], float] = lambda: REST_S) -> None:
        """Do `action` with whether the camera still moves; one at a time.

        Args:
            action: What is done.
            rest: Seconds after which a camera that has not moved is at rest.
        """
        self.action, self.rest, self.moves, self.ended = action, rest, threading.Event(), False
        threading.Thread(target=self._run, name="follow a camera", daemon=True).start()

    def moved(self, _camera: Any = None) -> None:
        """The camera has moved."""
        self.moves.set()

    def stop(self) -> None:
        """End the thread, after what it does now."""
        self.ended = True
        self.moves.set()

    def _run(self) -> None:
        while True:
            self.moves.wait()
            while self.moves.wait(self.rest()):
                self.moves.clear()
                if self.ended:
                    return
                self.action(True)
                time.sleep(TICK_S)
            self.action(False)


@dataclass(frozen=True)
class BrowserCamera:
    """Where a browser's camera is.

    Attributes:
        eye: What it sees.
        distance: Of what it turns about, local units.
    """

    eye: LodCamera
    distance: float

    @classmethod
    def of(cls, camera: viser.CameraHandle) -> BrowserCamera:
        """That of now."""
        width, height = max(int(camera.image_width), 1), max(int(camera.image_height), 1)
        focal = height / 2 / math.tan(camera.fov / 2)
        pose = torch.from_numpy(pose_of(camera))
        lens = Camera(pose, focal, focal, width / 2, height / 2, width, height)
        away = float(np.linalg.norm(np.asarray(camera.look_at) - np.asarray(camera.position)))
        return cls(LodCamera(lens, camera.near / WORLD), away / WORLD)

    def same_as(self, other: BrowserCamera) -> bool:
        """Whether both see the same."""
        one, two = self.eye.camera, other.eye.camera
        lenses = [(each.fx, each.width, each.height) for each in (one, two)]
        return lenses[0] == lenses[1] and torch.equal(one.world_to_camera, two.world_to_camera)

    def far_from(self, other: BrowserCamera) -> bool:
        """Whether the camera has moved far since it was there."""
        one, two = self.eye.camera, other.eye.camera
        gone = float((one.centre - two.centre).norm())
        ahead = float(one.world_to_camera[2, :3] @ two.world_to_camera[2, :3])
        return gone > FAR_MOVE_SHARE * other.distance or ahead < math.cos(math.radians(FAR_DEGREES))


class CameraPose:
    """Where a browser's camera was when things were last chosen for it."""

    def __init__(self, client: viser.ClientHandle) -> None:
        """Nowhere yet."""
        self.client, self.chosen = client, 0.0
        self.stand: BrowserCamera | None = None

    def begin(self) -> BrowserCamera:
        """Where it is now: things are about to be chosen."""
        self.chosen, self.stand = time.monotonic(), None
        return BrowserCamera.of(self.client.camera)

    def serves(self, stand: BrowserCamera, fewer: bool = False) -> bool:
        """Whether what was chosen for a camera is still wanted; if not, the next choice is.

        Args:
            stand: That camera.
            fewer: It is less than the browser has, which is too slow for more: it is wanted in any case.
        """
        if BrowserCamera.of(self.client.camera).far_from(stand):
            return fewer
        self.stand = stand
        return True

    def is_due(self, moves: bool) -> bool:
        """Whether to choose again."""
        if moves and time.monotonic() - self.chosen < BETWEEN_S:
            return False
        here = BrowserCamera.of(self.client.camera)
        return self.stand is None or (here.far_from(self.stand) if moves else not here.same_as(self.stand))


def telling(client: viser.ClientHandle, action: Callable[..., None]) -> Callable[[Any], None]:
    """A callback that shows what a user can correct as a note on the page."""

    def guarded(event: Any) -> None:
        try:
            action(event)
        except (BadInput, OSError) as error:
            client.add_notification("That did not work", " ".join(str(error).split()), color="red")

    return guarded


def set_value(part: viser.GuiInputHandle[T], value: T) -> None:
    """Set what an input shows."""
    part.value = value  # type: ignore[misc]  # read-only for mypy, as viser declares the setter apart from the getter


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
    turn = numpy_rotations(np.asarray(camera.wxyz)[None])[0].T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ (np.asarray(camera.position, np.float64) / WORLD)
    return pose


def quaternion_of(pose: np.ndarray) -> np.ndarray:
    """(4,) wxyz of the rotation from the axes of a camera to the world."""
    return numpy_quaternions(np.asarray(pose[None, :3, :3]).transpose(0, 2, 1))[0]


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
