"""A survey of flat ground whose colours are known everywhere, by photographs whose light is known exactly."""

from dataclasses import dataclass

import numpy as np
from PIL import Image
from town import sheet

from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View
from surfkit.scene.srgb import from_linear

HALF = 9.0
"""Of the sides of the ground, metres."""
ACROSS, DOWN, HEIGHT = 5, 4, 5.0
"""Photographs in a row, rows, and metres above the ground."""
WIDTH, DEPTH, FOCAL = 160, 120, 110.0
HIDDEN = (20, 20, 230)
"""Colour of all vertices: where no photograph shows the ground, it is what is left."""


def ground(x, y):
    """(..., 3) linear light of the ground: fields, furrows and a few bright roofs."""
    field = 0.5 + 0.3 * np.sin(0.9 * x + 0.4) * np.cos(0.7 * y) + 0.2 * np.sin(2.3 * x - 1.1 * y)
    furrow = 1 + 0.35 * np.sin(5.1 * x + 2 * np.sin(1.3 * y)) * np.sin(4.3 * y)
    hue = np.stack([0.5 + 0.2 * np.sin(0.8 * y), 0.55 + 0 * x, 0.4 + 0.2 * np.cos(0.6 * x)], axis=-1)
    roof = (np.sin(1.9 * x + 1) * np.sin(1.7 * y) > 0.93)[..., None]
    return np.where(roof, 0.85, 0.12 + 0.3 * (field * furrow).clip(0)[..., None] * hue)


@dataclass(frozen=True)
class FlownGround:
    """The mesh, its photographs, and what the light of these was multiplied by.

    Attributes:
        gain: (V, 3) exposure and white balance.
        corner: Light of the corners of all photographs, of their middle.
    """

    surface: SurfaceFile
    frame: Frame
    views: tuple[View, ...]
    gain: np.ndarray
    corner: float


def vignetting(x, y, corner):
    """(...) light at places of a picture in pixels, of that in the middle: the law of the fourth power of a cosine."""
    square = ((x - WIDTH / 2) ** 2 + (y - DEPTH / 2) ** 2) / ((WIDTH**2 + DEPTH**2) / 4)
    return (1 + (corner**-0.5 - 1) * square) ** -2


def flown_ground(folder, stops=1.0, balance=0.15, corner=0.6, seed=0, cell=0.25):
    """The scene with its photographs in a folder, with exposures of so many stops up and down, and so on, which have no
    trend over the ground."""
    draw, views, gain = np.random.default_rng(seed), [], []
    row, column = np.mgrid[:DEPTH, :WIDTH] + 0.5
    frame = Frame(np.zeros(3), 0.1, 1.0)
    spots = [(x, y) for y in np.linspace(-6, 6, DOWN) for x in np.linspace(-6, 6, ACROSS)]
    factors = draw.uniform(-stops, stops, (len(spots), 1)) + np.log2(
        1 + draw.uniform(-balance, balance, (len(spots), 3))
    )
    trend = np.column_stack([spots, np.ones(len(spots))])  # over flat ground, it cannot be told from a bright side
    factors -= trend[:, :2] @ np.linalg.lstsq(trend, factors, rcond=None)[0][:2]
    for at, ((x, y), factor) in enumerate(zip(spots, 2**factors, strict=True)):
        turn = np.deg2rad(draw.uniform(-8, 8))
        cos, sin = np.cos(turn), np.sin(turn)
        pose = np.eye(4)
        pose[:3, :3] = np.array([[cos, sin, 0], [sin, -cos, 0], [0, 0, -1]])
        pose[:3, 3] = -pose[:3, :3] @ [x, y, HEIGHT]
        camera = Camera(frame.local_pose(pose), FOCAL, FOCAL, WIDTH / 2, DEPTH / 2, WIDTH, DEPTH)
        rays = np.stack([(column - WIDTH / 2) / FOCAL, (row - DEPTH / 2) / FOCAL, np.ones_like(row)], -1)
        places = np.array([x, y, HEIGHT]) + HEIGHT * rays @ pose[:3, :3]
        light = 0.9 * ground(places[..., 0], places[..., 1]) * factor * vignetting(column, row, corner)[..., None]
        light[np.abs(places[..., :2]).max(-1) > HALF] = 0
        path = folder / f"{at:02d}.png"
        Image.fromarray(np.rint(255 * from_linear(light.clip(0, 1))).astype(np.uint8)).save(path)
        views.append(View(path.name, camera, path))
        gain.append(factor)
    return FlownGround(ground_mesh(cell), frame, tuple(views), np.array(gain), corner)


def ground_mesh(cell):
    vertices, faces = sheet((-HALF, -HALF, 0), 2 * HALF * np.eye(3)[0], 2 * HALF * np.eye(3)[1], cell)
    rows = np.zeros(len(vertices), [*((a, "<f8") for a in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    rows["x"], rows["y"], rows["z"] = vertices.T
    rows["red"], rows["green"], rows["blue"] = HIDDEN
    return SurfaceFile("mesh.ply", rows, faces.astype(np.int32))
