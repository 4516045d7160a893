"""A path of the camera through key views, in the file that `surfkit render --path` reads: that of nerfstudio."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.apps.render.path import MAX_FRAMES, OPENGL, through
from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame

KEYFRAME_HEIGHT_PX = 1080
"""Of the pictures that the file suggests, pixels; `surfkit render --size` has the last word."""


@dataclass(frozen=True)
class KeyPath:
    """Key views and their timing.

    Attributes:
        poses: (4, 4) float64 world_to_camera of each, local frame.
        seconds: Of the whole path.
        fps: Frames per second.
        fov_degrees: Vertical field of view.
    """

    poses: Sequence[np.ndarray]
    seconds: float = 10.0
    fps: float = 30.0
    fov_degrees: float = 60.0

    def cameras(self) -> Sequence[Camera]:
        """One for each frame, on a smooth path through the key views.

        Raises:
            BadInput: There are fewer than two key views, or too many frames.
        """
        if len(self.poses) < 2:
            raise BadInput("a path needs at least two key views: add one, move the camera, and add another")
        frames = max(2, round(self.seconds * self.fps))
        if frames > MAX_FRAMES:
            raise BadInput(f"{frames} frames are too many for a path: {MAX_FRAMES} at most; give fewer seconds")
        focal = KEYFRAME_HEIGHT_PX / (2 * math.tan(math.radians(self.fov_degrees) / 2))
        width = KEYFRAME_HEIGHT_PX * 16 // 9
        keys = [
            Camera(torch.from_numpy(pose), focal, focal, width / 2, KEYFRAME_HEIGHT_PX / 2, width, KEYFRAME_HEIGHT_PX)
            for pose in self.poses
        ]
        return through(keys, keys[0], frames).cameras


def write_path(path: Path, keys: KeyPath, frame: Frame) -> int:
    """Write a camera path in the frame of the data set, and return how many frames it has.

    Raises:
        BadInput: As for `KeyPath.cameras`.
    """
    rows: list[dict[str, Any]] = []
    for camera in keys.cameras():
        pose = np.eye(4)
        pose[:3, :3] = camera.world_to_camera[:3, :3].T.numpy() @ OPENGL
        pose[:3, 3] = frame.to_input(camera.centre.numpy())
        rows.append(
            {"camera_to_world": pose.ravel().tolist(), "fov": keys.fov_degrees, "aspect": camera.width / camera.height}
        )
    lens = {"render_height": KEYFRAME_HEIGHT_PX, "render_width": KEYFRAME_HEIGHT_PX * 16 // 9}
    content = {"camera_type": "perspective", **lens, "fps": keys.fps, "seconds": keys.seconds, "camera_path": rows}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, content)
    return len(rows)
