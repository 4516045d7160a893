"""A box on a square of ground, with colours that are known everywhere, and photographs of it."""

from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image

from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View
from surfkit.scene.srgb import from_linear, linear
from surfkit.testing.synthetic import Box, GroundPlane

HALF = 6.0
BOX = Box((-2.0, -1.5, 0.0), (1.0, 1.5, 2.5))
WIDTH, HEIGHT = 200, 150
HIDDEN = (20, 20, 230)
"""Colour of all vertices: where no photograph shows the surface, it is what is left."""
CAR = Box((2.5, 2.0, 0.0), (4.5, 3.2, 0.6))
"""Stands on the ground in one photograph only."""
YELLOW = np.array([0.95, 0.95, 0.05])


def truth(places, on_box):
    """(P, 3) colours in [0, 1]: the ground is green, the box is red, and both have waves."""
    x, y, z = places.T
    on_box = np.broadcast_to(on_box, x.shape)
    wave = 0.5 + 0.25 * np.sin(1.7 * x + 0.5) * np.cos(1.4 * y) + 0.2 * np.sin(1.9 * z + 0.6 * x)
    red, green = np.where(on_box, 0.85, 0.15), np.where(on_box, 0.15, 0.75)
    return np.stack([red, green, wave], axis=1)


def looking(eye, target):
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, [0.0, 1.0, 0.0] if abs(z[2]) > 0.99 else [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def poses():
    """Four that look down, and eight from around."""
    down = [looking((x, y, 11.0), (x, y, 0.0)) for x in (-2.5, 2.5) for y in (-2.5, 2.5)]
    turns = 2 * np.pi * (np.arange(8) + 0.3) / 8
    return down + [looking((10 * np.cos(t), 10 * np.sin(t), 6.5), (0.0, 0.0, 0.5)) for t in turns]


def seen_from(eye, rays, shapes):
    """(R,) how far along the rays, and (R,) which of the shapes, they meet first."""
    hits = np.stack([shape.hit(np.broadcast_to(eye, rays.shape), rays)[0] for shape in shapes])
    return hits.min(0), hits.argmin(0)


def photo_of(pose, camera, with_car):
    """(H, W, 3) colours in [0, 1]; beyond the square there is nothing, black."""
    rays = camera.rays(torch.float64).flatten(1).T.numpy() @ pose[:3, :3]
    eye = -pose[:3, :3].T @ pose[:3, 3]
    far, which = seen_from(eye, rays, [GroundPlane(), BOX, *([CAR] if with_car else [])])
    places = eye + np.where(np.isfinite(far), far, 0)[:, None] * rays
    color = truth(places, which == 1)
    color[which == 2] = YELLOW
    color[~np.isfinite(far) | (np.abs(places[:, :2]).max(1) > HALF)] = 0
    return color.reshape(camera.height, camera.width, 3)


@dataclass(frozen=True)
class Town:
    surface: SurfaceFile
    frame: Frame
    views: tuple[View, ...]


def town(folder, exposures=None, car=None, crs=None, cell=0.5, move=(0.0, 0.0, 0.0)):
    """The scene with its photographs in a folder.

    exposures: what the light of each photograph is multiplied by; car: number of the photograph with a car; move: of
    the coordinates of the data set.
    """
    frame = Frame(np.array([1.0, 2.0, 0.5]) + move, 0.05, 1.0, crs, shift=tuple(map(float, move)))
    views = []
    for at, pose in enumerate(poses()):
        moved = pose.copy()
        moved[:3, 3] -= pose[:3, :3] @ move
        camera = Camera(frame.local_pose(moved), 150.0, 151.0, 0.52 * WIDTH, 0.49 * HEIGHT, WIDTH, HEIGHT)
        color = photo_of(pose, camera, at == car)
        if exposures is not None:
            color = from_linear(linear(color) * exposures[at])
        path = folder / f"{at:02d}.png"
        Image.fromarray((color * 255).round().clip(0, 255).astype(np.uint8)).save(path)
        views.append(View(path.name, camera, path))
    return Town(surface(cell, move), frame, tuple(views))


def sheet(corner, along, across, cell):
    """Vertices and triangles of a parallelogram, in cells of about the size."""
    n, m = (max(1, round(np.linalg.norm(side) / cell)) for side in (along, across))
    i, j = np.meshgrid(np.arange(n + 1) / n, np.arange(m + 1) / m, indexing="ij")
    places = np.asarray(corner) + i.reshape(-1, 1) * along + j.reshape(-1, 1) * across
    number = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return places, np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])


def surface(cell, move=(0.0, 0.0, 0.0)):
    """The ground, also under the box, and the box without its floor."""
    low, high = np.array(BOX.low), np.array(BOX.high)
    size, x, y, z = high - low, *np.eye(3)
    sheets = [sheet((-HALF, -HALF, 0), 2 * HALF * x, 2 * HALF * y, cell)]
    sheets += [sheet((low[0], low[1], high[2]), size[0] * x, size[1] * y, cell)]
    for corner, along in ((low, x), (low + size[1] * y, x), (low, y), (low + size[0] * x, y)):
        sheets.append(sheet(corner, (size @ along) * along, size[2] * z, cell))
    starts = np.cumsum([0, *(len(places) for places, _ in sheets)])
    rows = np.zeros(starts[-1], [*((axis, "<f8") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    rows["x"], rows["y"], rows["z"] = (np.concatenate([places for places, _ in sheets]) + move).T
    rows["red"], rows["green"], rows["blue"] = HIDDEN
    faces = np.concatenate([part + start for (_, part), start in zip(sheets, starts, strict=False)])
    return SurfaceFile("mesh.ply", rows, faces.astype(np.int32))


def is_seen(places, only=range(12)):
    """(V, P) whether each photograph really shows places on the surface; `only` asks for some photographs."""
    found = np.zeros((len(poses()), len(places)), bool)
    for at, pose in enumerate(poses()):
        if at not in only:
            continue
        eye = -pose[:3, :3].T @ pose[:3, 3]
        far, _ = seen_from(eye, places - eye, [GroundPlane(), BOX])
        local = places @ pose[:3, :3].T + pose[:3, 3]
        x = 150.0 * local[:, 0] / local[:, 2] + 0.52 * WIDTH
        y = 151.0 * local[:, 1] / local[:, 2] + 0.49 * HEIGHT
        inside = (local[:, 2] > 0) & (x > 1) & (x < WIDTH - 1) & (y > 1) & (y < HEIGHT - 1)
        found[at] = inside & (far > 1 - 1e-6)
    return found


def on_box(places):
    """(P,) whether places on the surface lie on the box, and not on the ground."""
    return places[:, 2] > 1e-3


def is_clear(places, away=0.25):
    """(P,) whether places are so far from all edges of the box and of the ground: at these, texels mix two surfaces."""
    sides = np.abs(places[:, None] - np.array([BOX.low, BOX.high])).min(1) < away
    ground = (BOX.distance(places) > away) & (np.abs(places[:, :2]).max(1) < HALF - away)
    return np.where(on_box(places), sides.sum(1) <= 1, ground)
