"""The box around a scene, in whose coordinates the field lives, and the rays that cross it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.plugin import BadInput, Camera, Scene
from surfkit_neus.field import Shape

FEWEST = 10
"""Sparse points that a box can be told from."""
OUTLIERS = 0.01
"""Share of the points that is left out at each end of each axis."""
INNER = 0.9
"""Share of the points, those nearest to the middle, that the axes of the box are told from."""
FLATTEST = 0.1
"""The box is at least this high, as a share of its length."""
AROUND = 0.5
"""Cameras whose directions from the middle of the scene have a mean vector shorter than this stand all around it."""
NEAREST = 0.01
"""Where rays begin, in lengths of the box, for cameras inside it."""


@dataclass(frozen=True)
class SceneBox:
    """A box in the local frame, and the frame of its own in which it reaches from -1 to 1 along its longest axis.

    Attributes:
        centre: (3,) float64, local frame.
        axes: (3, 3) float64, orthonormal rows: the axes of the box in the local frame; the last one points up, to
            where the cameras are.
        scale: Local units per unit of the box.
        halves: (3,) float64 half the sides in units of the box; the largest is 1.
        shape: That fits the cameras: a plane where they look at the scene from one side, a sphere where from all.
        level: Height of the plane, where the points lie; minus the radius of the sphere.
    """

    centre: Tensor
    axes: Tensor
    scale: float
    halves: Tensor
    shape: Shape
    level: float

    def inward(self, local: Tensor) -> Tensor:
        """(P, 3) float64 positions in the box of positions in the local frame."""
        return (local.double() - self.centre) @ self.axes.T / self.scale

    def outward(self, x: Tensor) -> Tensor:
        """(P, 3) float64 positions in the local frame of positions in the box."""
        return x.double() * self.scale @ self.axes + self.centre

    def holds(self, x: Tensor) -> Tensor:
        """(P,) bool, whether positions (P, 3) lie in the box."""
        return (x.abs() <= self.halves.to(x)).all(1)


@dataclass(frozen=True)
class Rays:
    """R rays in the frame of the box.

    Attributes:
        origin: (R, 3) float32.
        direction: (R, 3) float32 unit vectors.
        near, far: (R,) where they enter and leave the box; the same for rays that miss it.
        depth: (R,) camera z, in local units, of a point at distance 1 along the ray.
    """

    origin: Tensor
    direction: Tensor
    near: Tensor
    far: Tensor
    depth: Tensor

    def __len__(self) -> int:
        return len(self.origin)

    def at(self, t: Tensor) -> Tensor:
        """(R, N, 3) positions at distances (R, N)."""
        return self.origin[:, None] + t[:, :, None] * self.direction[:, None]

    def take(self, rows: Tensor | slice) -> Rays:
        """Some of them."""
        return Rays(self.origin[rows], self.direction[rows], self.near[rows], self.far[rows], self.depth[rows])

    def to(self, device: torch.device) -> Rays:
        """The same on a device."""
        tensors = (self.origin, self.direction, self.near, self.far, self.depth)
        return Rays(*(tensor.to(device) for tensor in tensors))


def joined(parts: Sequence[Rays]) -> Rays:
    """All rays of several, in order."""
    names = ("origin", "direction", "near", "far", "depth")
    return Rays(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def scene_box(scene: Scene, margin: float) -> SceneBox:
    """The box around the sparse points, but for outliers, with its thinnest axis towards the cameras.

    Args:
        scene: Sparse points and training views.
        margin: Added at each side, as a share of the side; above and below, of the longest side.

    Raises:
        BadInput: There are too few points, or they lie in one place.
    """
    points = scene.cloud.xyz.double()
    points = points[torch.isfinite(points).all(1)]
    if len(points) < FEWEST:
        raise BadInput(
            f"{scene.name}: {len(points)} sparse points do not tell where the scene is; the scene box needs {FEWEST}"
        )
    cameras = torch.stack([view.camera.centre for view in scene.train])
    middle = points.median(0).values
    inner = points[(points - middle).norm(dim=1).argsort()[: max(FEWEST, round(INNER * len(points)))]]
    axes = torch.linalg.svd(inner - inner.mean(0), full_matrices=False)[2]
    axes = _upright(axes, (cameras - middle).mean(0))
    along = torch.stack([_ends(column, OUTLIERS) for column in ((points - middle) @ axes.T).unbind(1)], 1)
    sides = along[1] - along[0]
    longest = float(sides.max())
    if not longest > 0:
        raise BadInput(f"{scene.name}: the sparse points lie in one place; the scene box needs a size")
    pad = margin * torch.stack([sides[0], sides[1], sides.max()])
    halves = (0.5 * sides + pad).clamp_min(0.5 * FLATTEST * longest)
    centre = middle + along.mean(0) @ axes
    scale = float(halves.max())
    towards = torch.nn.functional.normalize(cameras - centre, dim=1).mean(0)
    shape: Shape = "plane" if float(towards.norm()) > AROUND else "sphere"
    height = float(((points - centre) @ axes[2]).median()) / scale
    return SceneBox(centre, axes, scale, halves / scale, shape, height if shape == "plane" else -0.5)


def _upright(axes: Tensor, up: Tensor) -> Tensor:
    """Right-handed axes of which the last points to where the cameras are."""
    last = axes[2] * (1 if float(axes[2] @ up) >= 0 else -1)
    return torch.stack([axes[0], torch.linalg.cross(last, axes[0]), last])


def _ends(values: Tensor, left_out: float) -> Tensor:
    """(2,) quantiles of (P,) values; `torch.quantile` does not take as many as there may be."""
    ordered = values.sort().values
    last = len(ordered) - 1
    return torch.stack([ordered[round(left_out * last)], ordered[round((1 - left_out) * last)]])


def camera_rays(camera: Camera, box: SceneBox, pixels: Tensor) -> Rays:
    """The rays through the centres of pixels (R,), numbered row by row."""
    x = (pixels % camera.width + 0.5 - camera.cx) / camera.fx
    y = (pixels // camera.width + 0.5 - camera.cy) / camera.fy
    seen = torch.stack([x, y, torch.ones_like(x)], 1).double()
    length = seen.norm(dim=1)
    turn = box.axes @ camera.world_to_camera[:3, :3].T
    direction = (seen / length[:, None]) @ turn.T
    origin = box.inward(camera.centre[None]).expand_as(direction)
    near, far = crossing(origin, direction, box.halves)
    values = (origin, direction, near, far, box.scale / length)
    return Rays(*(value.float() for value in values))


def crossing(origin: Tensor, direction: Tensor, halves: Tensor) -> tuple[Tensor, Tensor]:
    """(R,) distances above 0 at which rays enter and leave a box around 0; where they miss it, both are that at which
    they pass the middle."""
    safe = torch.where(direction.abs() < 1e-12, 1e-12, direction)
    one, other = (-halves - origin) / safe, (halves - origin) / safe
    near = torch.minimum(one, other).amax(1).clamp_min(NEAREST)
    far = torch.maximum(one, other).amin(1)
    passed = -(origin * direction).sum(1).clamp_max(-NEAREST)
    return torch.where(near < far, near, passed), torch.where(near < far, far, passed)
