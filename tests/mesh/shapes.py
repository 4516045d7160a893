"""Solids with exact distances, cameras around them, and what these see: by walking along every ray, in float64."""

from functools import cache

import numpy as np
import torch

from surfkit.mesh.base import MeshInput
from surfkit.raster.api import Maps, Splats
from surfkit.raster.reference import Reference
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View


def sphere(points, radius=0.5):
    return np.linalg.norm(points, axis=-1) - radius


def torus(points, large=0.5, small=0.2):
    ring = np.linalg.norm(points[..., :2], axis=-1) - large
    return np.hypot(ring, points[..., 2]) - small


def slope(points):
    """A plane through the origin, not along the lattice; below it is inside."""
    return points @ (np.array([0.2, 0.3, 0.9]) / np.linalg.norm([0.2, 0.3, 0.9]))


def look_at(eye, at=(0.0, 0.0, 0.0), focal=90.0, size=(96, 72)):
    eye = np.asarray(eye, float)
    z = np.asarray(at) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1] if abs(z[2]) < 0.9 else [0, 1, 0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = x, np.cross(z, x), z
    pose[:3, 3] = -pose[:3, :3] @ eye
    # The principal point is not in the middle: it must be honoured.
    return Camera(torch.from_numpy(pose), focal, focal, size[0] / 2 + 3.3, size[1] / 2 - 2.1, *size)


def around(count, distance=2.0, above=False, **how):
    """Cameras evenly around the origin, or only above it."""
    heights = (np.arange(count) + 0.5) / count
    z = 0.4 + 0.6 * heights if above else 1 - 2 * heights
    turn = 2.399963 * np.arange(count)
    flat = np.sqrt(1 - z**2)
    return [look_at(distance * p, **how) for p in np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)]


def seen(camera, shape):
    """(H, W) float64 camera z of the first surface, 0 for none; (3, H, W) normals in the camera's frame."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return tuple(map(np.copy, walked(tuple(camera.world_to_camera.flatten().tolist()), lens, shape)))


@cache
def walked(pose, lens, shape):
    camera = Camera(torch.tensor(pose, dtype=torch.float64).reshape(4, 4), *lens)
    pose = camera.world_to_camera.numpy()
    eye = -pose[:3, :3].T @ pose[:3, 3]
    rays = camera.rays(torch.float64).numpy().reshape(3, -1).T @ pose[:3, :3]
    lengths = np.linalg.norm(rays, axis=1)
    t = np.zeros(len(rays))
    for _ in range(200):
        step = shape(eye + t[:, None] * rays) / lengths
        t = np.minimum(t + step, 20.0)
        if np.abs(step[t < 20]).max(initial=0) < 1e-9:
            break
    hit = eye + t[:, None] * rays
    there = (np.abs(shape(hit)) < 1e-6) & (t < 19)
    step = 1e-5 * np.eye(3)
    normals = np.stack([shape(hit + d) - shape(hit - d) for d in step], 1) / 2e-5
    size = (camera.height, camera.width)
    return np.where(there, t, 0).reshape(size), (normals * there[:, None] @ pose[:3, :3].T).T.reshape(3, *size)


def maps_of(camera, shape, color=(0.8, 0.4, 0.2)):
    depth, normal = (torch.from_numpy(a).float() for a in seen(camera, shape))
    alpha = (depth > 0).float()
    return Maps(torch.tensor(color)[:, None, None] * alpha, alpha, depth, depth, normal)


def subject(cameras, shape, **changes):
    """What a mesher is given, with exact maps, and splats that only tell where the surface is."""
    found = {f"{at}": maps_of(camera, shape) for at, camera in enumerate(cameras)}
    views = [View(name, camera, None) for name, camera in zip(found, cameras, strict=True)]
    points = []
    for camera in cameras:
        depth = seen(camera, shape)[0].reshape(-1)
        pose = camera.world_to_camera.numpy()
        local = camera.rays(torch.float64).numpy().reshape(3, -1) * depth
        points.append((pose[:3, :3].T @ (local[:, depth > 0] - pose[:3, 3:])).T)
    means = torch.from_numpy(np.concatenate(points)).float()
    count = len(means)
    splats = Splats(
        "surfel", means, torch.ones(count, 4), torch.ones(count, 2), torch.ones(count), torch.ones(count, 1, 3)
    )
    given = {
        "splats": splats,
        "views": views,
        "draw": lambda view: found[view.name],
        "rasterizer": Reference(),
        "near": 0.01,
        "frame": Frame(np.array([500_000.0, 5_700_000.0, 100.0]), 0.1, metres=1.0),
        "budget_bytes": 2**30,
    }
    return MeshInput(**(given | changes))
