"""Photographs of a small scene of known shape, with a texture that SIFT finds features in."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from surfkit.testing.synthetic import SURFACES

WIDTH, HEIGHT, FOCAL = 240, 180, 260.0


def looking(eye, target=(0.0, 0.0, 0.5), roll=0.0):
    """(4, 4) world_to_camera of a camera at `eye`, level but for `roll`."""
    eye = np.asarray(eye, np.float64)
    forward = np.asarray(target) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(forward, right), forward])
    cosine, sine = np.cos(roll), np.sin(roll)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ turn
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ eye
    return pose


def arc(count, start=0.0, step=0.16):
    """Poses on a rising arc about the scene."""
    angles = start + step * np.arange(count)
    return [
        looking((15 * np.cos(a), 15 * np.sin(a), 10 + 2.5 * (at % 3)), (0.3 * (at % 2), 0, 0.5))
        for at, a in enumerate(angles)
    ]


def picture(pose, seed=0, width=WIDTH, height=HEIGHT, motion=(0.0, 0.0, 0.0)):
    """(H, W, 3) uint8 of the scene with the texture of `seed`; the camera moves by `motion` from the first row to the
    last."""
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], -1).reshape(-1, 3) @ pose[:3, :3]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    origins = eye + (y.reshape(-1, 1) / height) * np.asarray(motion)
    depth = np.min([surface.hit(origins, rays)[0] for surface in SURFACES], axis=0)
    points = origins + np.where(np.isfinite(depth), depth, 0)[:, None] * rays
    lattice = np.random.default_rng(seed).uniform(-1, 1, (48, 48, 48))
    value = sum(
        weight * map_coordinates(lattice, (points * scale).T % 48, order=1, mode="grid-wrap")
        for scale, weight in ((0.7, 0.9), (1.9, 0.8), (4.1, 0.6))
    )
    grey = np.where(np.isfinite(depth), 128 + 70 * value, 230).clip(0, 255).reshape(height, width)
    return np.repeat(grey[..., None], 3, 2).round().astype(np.uint8)


def save(path: Path, pixels) -> Path:
    """The picture as a JPEG file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, quality=95)
    return path
