"""Paths of a camera: around a scene, over it, or from a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, Scene, View
from surfkit.scene.up_direction import up_direction

START_QUANTILE, END_QUANTILE = 0.05, 0.95
"""Where a flight over the scene begins and ends: quantiles of the camera positions along it."""
PITCH_DEGREES = 45.0
"""By which the camera looks down in a flight over the scene."""
LOW_HEIGHT_SHARE = 0.05
"""Height of the cameras above what they see, as a share of the length of the flight, below which they stand on the
ground and look ahead."""
MAX_SIDE_PX = 16384
"""Most pixels along a side of a picture."""
MAX_FRAMES = 1_000_000
OPENGL = np.diag([1.0, -1.0, -1.0])
"""Axes of nerfstudio's cameras (y up, z backward) in those of ours."""


@dataclass(frozen=True)
class CameraPath:
    """A path of the camera.

    Attributes:
        cameras: One for each frame, local frame.
        fps: Frames per second that the path itself asks for; None if it does not say.
    """

    cameras: Sequence[Camera]
    fps: float | None = None


def orbit(scene: Scene, lens: Camera, count: int) -> CameraPath:
    """A circle around the middle of the scene, to which the camera looks.

    Its height is the median of the training cameras above the middle, and its radius their median distance from the
    vertical line through it, or the height if that is larger, so that façades are seen.
    """
    up, middle = up_of(scene), middle_of(scene)
    apart = centres_of(scene.train) - middle
    height = float(np.median(apart @ up))
    radius = max(float(np.median(np.linalg.norm(apart - np.outer(apart @ up, up), axis=1))), abs(height))
    if not radius > 0:
        raise BadInput("--path orbit: all training cameras stand in the middle of the scene; give a file of cameras")
    east, north = beside(up)
    cameras = []
    for angle in 2 * math.pi * np.arange(count) / count:
        at = middle + radius * (math.cos(angle) * east + math.sin(angle) * north) + height * up
        cameras.append(looking(lens, at, middle - at, up))
    return CameraPath(cameras)


def flyover(scene: Scene, lens: Camera, count: int) -> CameraPath:
    """A straight flight along the direction in which the training cameras are spread most, at their median height.

    The camera looks ahead and down, and what it looks at moves from one end of the cameras to the other; where these
    stand on the ground, it stands there too and looks ahead.
    """
    up, middle, centres = up_of(scene), middle_of(scene), centres_of(scene.train)
    level = centres - np.outer(centres @ up, up)
    along = np.linalg.svd(level - level.mean(0), full_matrices=False)[2][0]
    along *= 1.0 if along[np.abs(along).argmax()] > 0 else -1.0
    begin, end = np.quantile(level @ along, [START_QUANTILE, END_QUANTILE])
    if not end - begin > 0:
        raise BadInput("--path flyover: all training cameras stand above one place; give --path orbit or a file")
    across = np.cross(up, along)
    height = float(np.median(centres @ up))
    above = height - float(middle @ up)
    pitch = math.radians(PITCH_DEGREES) if above > LOW_HEIGHT_SHARE * (end - begin) else 0.0
    ahead = math.cos(pitch) * along - math.sin(pitch) * up
    behind = above / math.tan(pitch) if pitch else 0.0
    start = float(np.median(level @ across)) * across + height * up - behind * along
    steps = np.linspace(begin, end, count)
    return CameraPath([looking(lens, start + step * along, ahead, up) for step in steps])


def through(keys: Sequence[Camera], lens: Camera, count: int) -> CameraPath:
    """A smooth path through given cameras, with equal speed between two of them that are equally far apart.

    Positions follow a cubic spline and directions one of rotations (scipy's RotationSpline), both without a jump in
    speed; several cameras in one place are turned through one after another.
    """
    if len(keys) == 1:
        return CameraPath([with_lens(lens, keys[0].world_to_camera)] * count)
    poses = np.stack([camera.world_to_camera.numpy() for camera in keys])
    turns = Rotation.from_matrix(poses[:, :3, :3].transpose(0, 2, 1))
    centres = np.stack([camera.centre.numpy() for camera in keys])
    apart = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    angle = (turns[:-1].inv() * turns[1:]).magnitude()
    typical = np.median(apart[apart > 0]) if (apart > 0).any() else 1.0
    length = np.maximum(apart / typical, np.maximum(angle, 1e-3))
    times = np.concatenate([[0.0], np.cumsum(length)])
    at = np.linspace(0, times[-1], count)
    positions, directions = CubicSpline(times, centres)(at), RotationSpline(times, turns)(at).as_matrix()
    return CameraPath([posed(lens, place, turn.T) for place, turn in zip(positions, directions, strict=True)])


def from_file(path: Path, frame: Frame, lens: Camera, count: int) -> CameraPath:
    """The cameras of a JSON file, in the frame of the data set.

    That of 3DGS viewers, as RUN/cameras.json, has cameras to fly through; a camera path of nerfstudio has one camera
    for each frame, with its own field of view.

    Raises:
        BadInput: The file is none of these, or a camera of it is damaged.
    """
    data = read_json(path, Any)
    if isinstance(data, dict) and isinstance(data.get("camera_path"), list) and data["camera_path"]:
        frames = data["camera_path"]
        if len(frames) > MAX_FRAMES:
            raise BadInput(f"{path}: it has {len(frames)} cameras; at most {MAX_FRAMES} frames are rendered")
        rate = data.get("fps")
        fps = float(rate) if isinstance(rate, (int, float)) and 0 < rate <= 1000 else None
        found = [_of_nerfstudio(each, f"{path}: camera {at}", lens, frame) for at, each in enumerate(frames)]
        return CameraPath(found, fps)
    if isinstance(data, list) and data:
        keys = [_of_viewer(each, f"{path}: camera {at}", lens, frame) for at, each in enumerate(data)]
        return through(keys, lens, count)
    raise BadInput(
        f"{path}: no cameras in it; give a list of cameras as in RUN/cameras.json, or a camera path of nerfstudio "
        "(an object with camera_path)"
    )


def lens_of(scene: Scene, size: tuple[int, int] | None) -> Camera:
    """A camera with the median focal length of the training cameras, and pictures of a size (width, height).

    The longer side has the field of view that it has in training. Without a size, pictures are as large as most
    training photographs.
    """
    cameras = [view.camera for view in scene.train]
    relative = float(np.median([camera.fx / max(camera.width, camera.height) for camera in cameras]))
    sizes = [(camera.width, camera.height) for camera in cameras]
    width, height = size or max(sorted(set(sizes)), key=sizes.count)
    focal = relative * max(width, height)
    return Camera(torch.eye(4, dtype=torch.float64), focal, focal, width / 2, height / 2, width, height)


def up_of(scene: Scene) -> np.ndarray:
    """(3,) unit vector, local frame."""
    return up_direction(None, scene.train, scene.frame, np.eye(4)).direction


def middle_of(scene: Scene) -> np.ndarray:
    """(3,) what is in the middle of the scene: the median sparse point; without any, what the cameras look at most."""
    if len(scene.cloud.xyz):
        return np.median(scene.cloud.xyz.double().numpy(), axis=0)
    poses = np.stack([view.camera.world_to_camera.numpy() for view in scene.train])
    flat = np.eye(3) - poses[:, 2, :3, None] * poses[:, 2, None, :3]  # of directions, the part across the optical axis
    sides = (flat @ centres_of(scene.train)[..., None]).sum(0)[:, 0]
    return np.linalg.lstsq(flat.sum(0), sides, rcond=1e-6)[0]


def centres_of(views: Sequence[View]) -> np.ndarray:
    """(V, 3) positions of the cameras."""
    return np.stack([view.camera.centre.numpy() for view in views])


def beside(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors on the ground, across each other."""
    first = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    first /= np.linalg.norm(first)
    return first, np.cross(up, first)


def looking(lens: Camera, at: np.ndarray, ahead: np.ndarray, up: np.ndarray) -> Camera:
    """The camera at a place, held level, that looks in a direction."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6:  # straight down
        right = beside(up)[0]
    right /= np.linalg.norm(right)
    return posed(lens, at, np.stack([right, np.cross(ahead, right), ahead]))


def posed(lens: Camera, at: np.ndarray, turn: np.ndarray) -> Camera:
    """The camera at a place, with a (3, 3) rotation from the world to its axes."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ at
    return with_lens(lens, torch.from_numpy(pose))


def with_lens(lens: Camera, pose: torch.Tensor) -> Camera:
    """The camera with another pose."""
    return Camera(pose, lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height)


def _of_viewer(row: Any, where: str, lens: Camera, frame: Frame) -> Camera:
    """A camera of the cameras.json of 3DGS viewers: position, and rotation from its axes to the world."""
    position, turn = (_numbers(row, name, shape, where) for name, shape in (("position", (3,)), ("rotation", (3, 3))))
    return posed(lens, frame.to_local(position + np.asarray(frame.shift)), _rotation(turn.T, where))


def _of_nerfstudio(row: Any, where: str, lens: Camera, frame: Frame) -> Camera:
    """A camera of a camera path: camera_to_world by rows with axes of OpenGL, and the vertical field of view."""
    pose = _numbers(row, "camera_to_world", (16,), where).reshape(4, 4)
    degrees = row.get("fov", math.degrees(2 * math.atan(lens.height / (2 * lens.fy))))
    if not isinstance(degrees, (int, float)) or not 0 < degrees < 180:
        raise BadInput(f"{where}: fov is {degrees!r}; give degrees between 0 and 180")
    focal = lens.height / (2 * math.tan(math.radians(degrees) / 2))
    zoomed = Camera(lens.world_to_camera, focal, focal, lens.cx, lens.cy, lens.width, lens.height)
    return posed(zoomed, frame.to_local(pose[:3, 3]), _rotation((pose[:3, :3] @ OPENGL).T, where))


def _numbers(row: Any, name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A part of a camera in a file, or BadInput."""
    try:
        values = np.array(row[name], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if values.shape != shape or not np.isfinite(values).all():
        raise BadInput(f"{where}: {name} must be {' x '.join(map(str, shape))} finite numbers")
    return values


def _rotation(turn: np.ndarray, where: str) -> np.ndarray:
    """The rotation nearest to a matrix, or BadInput if that is none."""
    if not np.abs(turn @ turn.T - np.eye(3)).max() < 1e-2 or not np.linalg.det(turn) > 0:
        raise BadInput(f"{where}: its rotation is no rotation matrix")
    return Rotation.from_matrix(turn).as_matrix()
