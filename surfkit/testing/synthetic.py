"""Small scenes of which every ray is known exactly: a textured ground with a box and a sphere."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.io.datasets.raw_dataset import load_pycolmap
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, Scene, SparsePoints, View


class SyntheticShape(ABC):
    """A shape in metres, z up."""

    @abstractmethod
    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays meet it first.

        Args:
            origins: (R, 3).
            directions: (R, 3) of any length.

        Returns:
            (R,) multiples of the direction, inf where the ray misses; (R, 3) outward unit normals there.
        """

    @abstractmethod
    def distance(self, points: np.ndarray) -> np.ndarray:
        """(P,) distances of (P, 3) points to it, metres."""


@dataclass(frozen=True)
class GroundPlane(SyntheticShape):
    """The plane z = 0."""

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `SyntheticShape.hit`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origins[:, 2] / directions[:, 2]
        return np.where(t > 0, t, np.inf), np.broadcast_to([0.0, 0.0, 1.0], directions.shape)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See `SyntheticShape.distance`."""
        return np.abs(points[:, 2])


@dataclass(frozen=True)
class Sphere(SyntheticShape):
    """A ball."""

    centre: tuple[float, float, float] = (4.0, -2.0, 2.2)
    radius: float = 2.2

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `SyntheticShape.hit`."""
        away = origins - self.centre
        a, b = (directions**2).sum(1), (away * directions).sum(1)
        root = b * b - a * ((away**2).sum(1) - self.radius**2)
        t = (-b - np.sqrt(root.clip(0))) / a
        t = np.where((root > 0) & (t > 0), t, np.inf)
        return t, (away + np.where(np.isfinite(t), t, 0)[:, None] * directions) / self.radius

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See `SyntheticShape.distance`."""
        return np.abs(np.linalg.norm(points - self.centre, axis=1) - self.radius)


@dataclass(frozen=True)
class Box(SyntheticShape):
    """A box with its sides along the axes."""

    low: tuple[float, float, float] = (-7.0, -2.0, 0.0)
    high: tuple[float, float, float] = (-1.5, 3.0, 3.0)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `SyntheticShape.hit`."""
        with np.errstate(divide="ignore"):
            sides = np.stack([(np.array(side) - origins) / directions for side in (self.low, self.high)])
        entry, leave = sides.min(0), sides.max(0).min(1)
        t, axis = entry.max(1), entry.argmax(1)
        normals = np.eye(3)[axis] * -np.sign(np.take_along_axis(directions, axis[:, None], 1))
        return np.where((t < leave) & (t > 0), t, np.inf), normals

    def distance(self, points: np.ndarray) -> np.ndarray:
        """See `SyntheticShape.distance`."""
        centre, half = (np.add(self.low, self.high)) / 2, np.subtract(self.high, self.low) / 2
        outside = np.abs(points - centre) - half
        return np.abs(np.linalg.norm(outside.clip(0), axis=1) + outside.max(1).clip(max=0))


SURFACES: tuple[SyntheticShape, ...] = (GroundPlane(), Box(), Sphere())
SURFACE_COLORS = np.array([[0.42, 0.52, 0.38], [0.66, 0.42, 0.34], [0.36, 0.48, 0.68]])
"""Mean colour of each surface."""


@dataclass(frozen=True)
class Flight:
    """How the scene is photographed."""

    kind: Literal["orbit", "grid"] = "orbit"
    """A circle looking at the middle, or an aerial grid looking down."""
    views: int = 12
    """Photographs."""
    width: int = 96
    """Pixels."""
    height: int = 72
    """Pixels."""
    points: int = 500
    """Sparse points."""
    test_every: int = 8
    """Every Nth photograph is held out, from the first on; 0 holds none."""
    seed: int = 0
    """Of the texture, the points and the small turns of the grid's cameras."""


@dataclass(frozen=True)
class Exact:
    """What a camera really sees, float64, sampled at the pixel centres.

    Attributes:
        color: (3, H, W) in [0, 1]; 0 where the ray meets nothing.
        depth: (H, W) camera z, local units; 0 where the ray meets nothing.
        normal: (3, H, W) unit vectors in the camera frame, facing the camera; 0 where the ray meets nothing.
    """

    color: Tensor
    depth: Tensor
    normal: Tensor


@dataclass(frozen=True)
class Synthetic:
    """A scene and the truth about it. The photographs are files only after `write_colmap`.

    Attributes:
        scene: In its local frame; the input frame is in metres, z up.
        exact: By name of the view.
    """

    scene: Scene
    exact: dict[str, Exact]


def photograph(flight: Flight | None = None) -> Synthetic:
    """The scene as `flight` sees it; the same one for the same settings."""
    flight = flight or Flight()
    if flight.views < 2:
        raise BadInput(f"views is {flight.views}; it must be 2 or more")
    draw = np.random.default_rng(flight.seed)
    waves = _waves(draw)
    poses = _orbit(flight) if flight.kind == "orbit" else _grid(flight, draw)
    lens = _lens(flight)
    names = [f"view_{i:03d}.png" for i in range(flight.views)]
    held_out = set(names[:: flight.test_every]) if flight.test_every else set()
    xyz, rgb = _sparse(flight, poses, waves, draw)
    frame = Frame.around(np.stack([p for n, p in zip(names, poses, strict=True) if n not in held_out]), xyz)
    views, exact = [], {}
    for name, pose in zip(names, poses, strict=True):
        camera = Camera(frame.local_pose(pose), width=flight.width, height=flight.height, **lens)
        views.append(View(name, camera, Path("images") / name))
        exact[name] = _exact(camera, pose, waves, frame.scale)
    cloud = SparsePoints(torch.from_numpy(frame.to_local(xyz).astype(np.float32)), torch.from_numpy(rgb))
    train = tuple(view for view in views if view.name not in held_out)
    return Synthetic(Scene("synthetic", train, tuple(v for v in views if v.name in held_out), cloud, frame), exact)


def look(flight: Flight, pose: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What rays of any camera meet in the scene of `flight`: multiples of the rays, and colours.

    Args:
        flight: Of which only the seed counts.
        pose: (4, 4) world_to_camera, metres.
        rays: (R, 3) directions in the frame of the camera.

    Returns:
        (R,) inf where they meet nothing; (R, 3) in [0, 1], 0 there.
    """
    origin, waves = -pose[:3, :3].T @ pose[:3, 3], _waves(np.random.default_rng(flight.seed))
    depth, _, color = _cast(np.broadcast_to(origin, rays.shape), rays @ pose[:3, :3], waves)
    return depth, color


def write_colmap(folder: Path, synthetic: Synthetic, binary: bool = False, tracks: bool = False) -> None:
    """Save the scene as a COLMAP folder: PNG photographs in images/, the model in sparse/0 in the input frame.

    Args:
        folder: To write into.
        synthetic: What to write.
        binary: Whether the model is in COLMAP's binary files, or in its text files.
        tracks: Whether every point is tracked through all the photographs that really show it, or through none.
    """
    from PIL import Image
    from scipy.spatial.transform import Rotation

    scene, model = synthetic.scene, folder / "sparse" / "0"
    model.mkdir(parents=True, exist_ok=True)
    for old in model.glob("*.bin"):  # they would win over the text files
        old.unlink()
    views = sorted([*scene.train, *scene.held_out], key=lambda view: view.name)
    xyz = scene.frame.to_input(scene.cloud.xyz.numpy())
    shots, seen_in = [], [""] * len(xyz)
    for i, view in enumerate(views, 1):
        path = folder / "images" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = (synthetic.exact[view.name].color.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        Image.fromarray(pixels).save(path)
        pose = scene.frame.input_pose(view.camera.world_to_camera)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        spots = _observed(xyz, pose, view.camera) if tracks else []
        for at, (point, _) in enumerate(spots):
            seen_in[point] += f" {i} {at}"
        line = " ".join(f"{_row(pixel)} {point + 1}" for point, pixel in spots)
        shots.append(f"{i} {_row([w, x, y, z, *pose[:3, 3]])} 1 {view.name}\n{line}\n")
    c = views[0].camera
    lens = f"1 PINHOLE {c.width} {c.height} {_row([c.fx, c.fy, c.cx, c.cy])}\n"
    colours = [f"{r} {g} {b}" for r, g, b in scene.cloud.rgb.tolist()]
    rows = zip(xyz, colours, seen_in, strict=True)
    points = [f"{i} {_row(at)} {colour} 0{track}\n" for i, (at, colour, track) in enumerate(rows, 1)]
    for part, lines in {"cameras": [lens], "images": shots, "points3D": points}.items():
        (model / f"{part}.txt").write_text("".join(lines))
    if binary:
        load_pycolmap().Reconstruction(str(model)).write_binary(str(model))
        for text in model.glob("*.txt"):
            text.unlink()


def _observed(xyz: np.ndarray, pose: np.ndarray, camera: Camera) -> list[tuple[int, np.ndarray]]:
    """Which of the (P, 3) points a camera really sees, and at which pixel."""
    rays = xyz @ pose[:3, :3].T + pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = camera.fx * rays[:, 0] / rays[:, 2] + camera.cx
        y = camera.fy * rays[:, 1] / rays[:, 2] + camera.cy
    inside = (rays[:, 2] > 0) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
    eye = -pose[:3, :3].T @ pose[:3, 3]
    first = np.min([shape.hit(np.broadcast_to(eye, xyz.shape), xyz - eye)[0] for shape in SURFACES], axis=0)
    seen = np.flatnonzero(inside & (first > 1 - 1e-4))
    return [(int(point), np.array([x[point], y[point]])) for point in seen]


def _row(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _lens(flight: Flight) -> dict[str, float]:
    """Intrinsics with a principal point off the centre and pixels that are not quite square."""
    w, h = flight.width, flight.height
    return {"fx": 0.9 * w, "fy": 0.91 * w, "cx": 0.53 * w, "cy": 0.48 * h}


def _waves(draw: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray]]:
    """The texture of each surface: wave vectors (4, 3), 1/m, and phases (4,); one of brightness, one a channel."""
    return [(draw.normal(0, 0.8, (4, 3)), draw.uniform(0, 2 * np.pi, 4)) for _ in SURFACES]


def _cast(origins: np.ndarray, directions: np.ndarray, waves: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(R,) depths along the directions (inf for a miss), (R, 3) normals and colours of what rays meet first."""
    hits = [surface.hit(origins, directions) for surface in SURFACES]
    first = np.argmin([t for t, _ in hits], axis=0)
    depth, normal, color = np.full(len(first), np.inf), np.zeros_like(directions), np.zeros_like(directions)
    for i, ((t, normals), (vectors, phases)) in enumerate(zip(hits, waves, strict=True)):
        here = (first == i) & np.isfinite(t)
        where = origins[here] + t[here, None] * directions[here]
        depth[here], normal[here] = t[here], normals[here]
        wave = np.sin(where @ vectors.T + phases)
        color[here] = SURFACE_COLORS[i] + 0.17 * wave[:, :1] + 0.11 * wave[:, 1:]
    return depth, normal, color


def _exact(camera: Camera, pose: np.ndarray, waves: list, scale: float) -> Exact:
    rotation = pose[:3, :3]
    rays = camera.rays(torch.float64).flatten(1).T.numpy() @ rotation  # to the world: R^T r
    origin = -rotation.T @ pose[:3, 3]
    depth, normal, color = _cast(np.broadcast_to(origin, rays.shape), rays, waves)

    def image(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values.T)).reshape(-1, camera.height, camera.width)

    return Exact(image(color), image(np.where(np.isfinite(depth), depth * scale, 0))[0], image(normal @ rotation.T))


def _sparse(
    flight: Flight, poses: list[np.ndarray], waves: list, draw: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) points on the visible surface, where random rays of random views end; (P, 3) uint8 colours."""
    lens, count = _lens(flight), 2 * flight.points
    picked = np.stack(poses)[draw.integers(len(poses), size=count)]
    x = (draw.uniform(0, flight.width, count) - lens["cx"]) / lens["fx"]
    y = (draw.uniform(0, flight.height, count) - lens["cy"]) / lens["fy"]
    rays = np.einsum("rij,ri->rj", picked[:, :3, :3], np.stack([x, y, np.ones_like(x)], 1))
    origins = -np.einsum("rij,ri->rj", picked[:, :3, :3], picked[:, :3, 3])
    depth, _, color = _cast(origins, rays, waves)
    found = np.flatnonzero(np.isfinite(depth))[: flight.points]
    return origins[found] + depth[found, None] * rays[found], (color[found] * 255).round().astype(np.uint8)


def _looking(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) world_to_camera of a camera at `eye` that looks at `target`."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def _orbit(flight: Flight) -> list[np.ndarray]:
    angles = 2 * np.pi * np.arange(flight.views) / flight.views
    eyes = np.stack([18 * np.cos(angles), 18 * np.sin(angles), 14 + 2 * np.cos(3 * angles)], 1)
    return [_looking(eye, np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])) for eye in eyes]


def _grid(flight: Flight, draw: np.random.Generator) -> list[np.ndarray]:
    columns = int(np.ceil(np.sqrt(flight.views)))
    rows = int(np.ceil(flight.views / columns))
    spots = [(x, y) for y in np.linspace(-7, 7, rows) for x in np.linspace(-8, 8, columns)][: flight.views]
    eyes = [np.array([x, y, 15.0]) + draw.normal(0, 0.3, 3) for x, y in spots]
    return [_looking(e, np.array([*(0.8 * e[:2] + draw.normal(0, 1, 2)), 0]), np.array([0.0, 1.0, 0.0])) for e in eyes]
