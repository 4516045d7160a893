"""Which way is up in the frame of the truth: told by the user, by a georeferenced frame, or by the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.scene.crop import Axis
from surfkit.scene.scene import Frame, View

MIN_PLANE_SPREAD = 0.05
"""Mean square of the sideways axes of the cameras along the second direction, from which they span a plane."""
MAX_TILT_RATIO = 0.2
"""Of that, along the third direction, up to which the cameras are held level."""
MAX_FLATNESS_RATIO = 0.5
"""Spread of the cameras along their thinnest direction, as a share of the next, below which they fly in a plane."""
SNAP_DEGREES = 5.0
"""From an axis of the frame within which that axis is meant."""


@dataclass(frozen=True)
class Up:
    """The direction that stands on the ground.

    Attributes:
        direction: (3,) unit vector, frame of the truth.
        source: What said so, for people.
    """

    direction: np.ndarray
    source: str

    @property
    def axis(self) -> Axis:
        """The axis of the frame that it is nearest to."""
        return ("x", "y", "z")[int(np.abs(self.direction).argmax())]

    @property
    def turn(self) -> np.ndarray:
        """(3, 3) unit vectors in rows: two on the ground, and up."""
        helper = np.eye(3)[int(np.abs(self.direction).argmin())]
        across = np.cross(helper, self.direction)
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(self.direction, across), self.direction])


def up_direction(axis: Axis | None, views: Sequence[View], frame: Frame | None, matrix: np.ndarray) -> Up:
    """Which way is up.

    Args:
        axis: What the user says; None to find out.
        views: Training views, perhaps none.
        frame: Of the views.
        matrix: (4, 4) from the input frame of the views to that of the truth.
    """
    if axis is not None:
        return Up(np.eye(3)["xyz".index(axis)], "--up")
    if frame is None or not views:
        return Up(np.eye(3)[2], "z, as no cameras are known")
    found = up_of_views(views, frame)
    if found is None:
        return Up(np.eye(3)[2], "z, as the cameras do not tell")
    turn = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
    return Up(_snapped(turn @ found), "cameras" if frame.crs is None else "georeferenced frame")


def map_axes(up: np.ndarray) -> np.ndarray:
    """(3, 3) unit vectors in rows: east, north and up for a direction that is up. For z, the axes of the frame.

    East is the x axis of the frame as far as it lies on the ground, or the y axis where x points up.
    """
    axis = np.eye(3)[0 if abs(up[0]) < 0.9 else 1]
    east = axis - up * (up @ axis)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up]) + 0.0


def up_of_views(views: Sequence[View], frame: Frame) -> np.ndarray | None:
    """(3,) unit vector, axes of the input: z of a georeferenced frame, else what the cameras tell, or None.

    That is the direction which no camera has to its side, as cameras are held level. Where all cameras head one way, it
    is any direction across it, and the one across the plane that they fly in counts.
    """
    if frame.crs is not None:
        return np.eye(3)[2]
    turns = np.stack([view.camera.world_to_camera[:3, :3].numpy() for view in views])
    spread, axes = np.linalg.eigh(np.einsum("vi,vj->ij", turns[:, 0], turns[:, 0]) / len(turns))
    if spread[1] < MIN_PLANE_SPREAD or spread[0] > MAX_TILT_RATIO * spread[1]:
        centres = np.stack([view.camera.centre.numpy() for view in views])
        values, axes = np.linalg.eigh(np.atleast_2d(np.cov(centres.T, bias=True)))
        spread = np.sqrt(values.clip(0))
        if not spread[1] > MIN_PLANE_SPREAD * spread[2] or spread[0] > MAX_FLATNESS_RATIO * spread[1]:
            return None
    heads = -(turns[:, 1] + turns[:, 2]).mean(0)  # up in the picture, or away from the ground that is looked at
    return axes[:, 0] * (1.0 if axes[:, 0] @ heads >= 0 else -1.0)


def _snapped(direction: np.ndarray) -> np.ndarray:
    """The axis of the frame within a few degrees of a (3,) unit vector, or else itself."""
    at = int(np.abs(direction).argmax())
    if abs(direction[at]) < np.cos(np.radians(SNAP_DEGREES)):
        return direction
    return np.eye(3)[at] * np.sign(direction[at])
