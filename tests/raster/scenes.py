"""Random and adversarial splats in front of a camera with a random pose, for the tests of the rasterizers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from surfkit.raster.api import ALONG_RAYS, PRIMITIVE_KINDS, Splats
from surfkit.scene.camera import Camera

NEAR = 0.05


class Draw:
    """Random numbers of one seed, float64."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator, dtype=torch.float64)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=self._generator, dtype=torch.float64)


def camera(draw: Draw, width: int = 61, height: int = 47) -> Camera:
    """A camera with a random pose, unequal focal lengths and the principal point off the centre."""
    turn = torch.linalg.qr(draw.normal(3, 3)).Q
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = turn * torch.sign(torch.linalg.det(turn))
    pose[:3, 3] = 0.3 * draw.normal(3)
    return Camera(pose, 0.85 * width, 1.2 * height, 0.45 * width, 0.6 * height, width, height)


def axis_camera(width: int = 61, height: int = 47) -> Camera:
    """A camera at the origin along z whose numbers are exact in binary, its axis through a pixel's centre."""
    pose = torch.eye(4, dtype=torch.float64)
    return Camera(pose, 52.0, 56.0, width // 2 - 3 + 0.5, height // 2 + 4 + 0.5, width, height)


def splats(draw: Draw, view: Camera, kind: str, degree: int, **given: Tensor) -> Splats:
    """Splats from float64 tensors, with random orientation and colours; `centres` are in the camera frame."""
    centres = given["centres"]
    count, pose = len(centres), view.world_to_camera
    quats = given.get("quats")
    if quats is None:
        quats = draw.normal(count, 4)
    means = (centres - pose[:3, 3]) @ pose[:3, :3]
    sh = 0.4 * draw.normal(count, (degree + 1) ** 2, 3)
    parts = means, quats, given["scales"], given["opacities"], sh[:, :1], sh[:, 1:]
    return Splats(kind, *(t.float() for t in parts))


def _box(draw: Draw, count: int, z_low: float = 1.0, z_high: float = 2.5) -> Tensor:
    low, high = torch.tensor([-1.0, -0.8, z_low]).double(), torch.tensor([1.0, 0.8, z_high]).double()
    return low + (high - low) * draw.uniform(0, 1, count, 3)


def _columns(kind: str) -> int:
    return 2 if kind == "surfel" else 3


def plain(kind: str, degree: int, seed: int, size: float = 1.0, depth: tuple[float, float] = (1.0, 2.5)):
    """Splats of a few pixels, many sizes and opacities; `size` multiplies them."""
    draw = Draw(seed)
    view, count = camera(draw), 70
    made = splats(
        draw, view, kind, degree,
        centres=_box(draw, count, *depth),
        scales=size * (0.5 * draw.normal(count, _columns(kind)) - 2.5).exp(),
        opacities=draw.uniform(0.02, 0.97, count),
    )  # fmt: skip
    return made, view


def needle(kind: str, degree: int, seed: int):
    """Aspect ratios up to 300."""
    draw = Draw(seed)
    view, count = camera(draw), 70
    long = draw.uniform(0.1, 0.6, count, 1)
    thin = long / torch.exp(draw.uniform(1.5, 5.7, count, _columns(kind) - 1))
    opacities = draw.uniform(0.1, 0.97, count)
    scales = torch.cat([thin, long], 1)
    return splats(draw, view, kind, degree, centres=_box(draw, count), scales=scales, opacities=opacities), view


def huge(kind: str, degree: int, seed: int):
    """Each covers most of the image."""
    return plain(kind, degree, seed, size=8.0)


def tiny(kind: str, degree: int, seed: int):
    """Much smaller than a pixel."""
    return plain(kind, degree, seed, size=0.02)


def around(kind: str, degree: int, seed: int):
    """Behind, across and close to the camera plane; one sits in the camera's centre."""
    made, view = plain(kind, degree, seed, depth=(-0.7, 0.8))
    made.means[0] = view.centre.float()
    return made, view


def opaque(kind: str, degree: int, seed: int):
    """Rays end after a few splats of opacity 0.999, stacked closely in depth."""
    made, view = plain(kind, degree, seed, size=1.5, depth=(1.5, 1.9))
    made.opacities.fill_(0.999)
    return made, view


def faint(kind: str, degree: int, seed: int):
    """Many layers of opacity 0.01 to 0.06."""
    draw = Draw(seed)
    view, count = camera(draw), 120
    made = splats(
        draw, view, kind, degree,
        centres=_box(draw, count),
        scales=(0.5 * draw.normal(count, _columns(kind)) - 1.8).exp(),
        opacities=draw.uniform(0.01, 0.06, count),
    )  # fmt: skip
    return made, view


def edge_on(kind: str, degree: int, seed: int):
    """Discs whose plane holds the camera's centre: exactly (whole columns and rows of pixels lie in it) and nearly."""
    draw, view = Draw(seed), axis_camera()
    count, exact = 60, 12
    centres = _box(draw, count)
    quats = torch.ones(count, 4).double()  # disc in the plane x = 0 of the camera
    quats[1::2, 1:] = -1  # in the plane y = 0
    centres[0::2, 0] = 0
    centres[1::2, 1] = 0
    tilt = torch.logspace(-7, -1, count - exact).double()[:, None]
    quats[exact:] += tilt * draw.normal(count - exact, 4)
    centres[exact:] += 0.2 * tilt * draw.normal(count - exact, 3)
    scales = draw.uniform(0.02, 0.2, count, _columns(kind))
    scales[:, 2:] *= 0.02  # an ellipsoid's thin axis
    opacities = draw.uniform(0.1, 0.97, count)
    return splats(draw, view, kind, degree, centres=centres, quats=quats, scales=scales, opacities=opacities), view


def grazing(kind: str, degree: int, seed: int):
    """Discs that a ray through their centre meets at 0.001 to 0.1 of a radian, from a random pose."""
    draw = Draw(seed)
    view, count = camera(draw), 60
    centres = _box(draw, count)
    ray = torch.nn.functional.normalize(centres, dim=1)
    side = torch.nn.functional.normalize(torch.linalg.cross(ray, draw.normal(count, 3)), dim=1)
    angle = torch.logspace(-3, -1, count).double()[:, None]
    along = angle.cos() * ray + angle.sin() * torch.linalg.cross(ray, side)
    axes = torch.stack([torch.linalg.cross(along, side), along, side], 2)[:, :, [1, 2, 0]]
    quats = quaternions(view.world_to_camera[:3, :3].T @ axes)
    scales = draw.uniform(0.02, 0.2, count, _columns(kind))
    scales[:, 2:] *= 0.02
    opacities = draw.uniform(0.1, 0.97, count)
    return splats(draw, view, kind, degree, centres=centres, quats=quats, scales=scales, opacities=opacities), view


def quaternions(turns: Tensor) -> Tensor:
    """(N, 4) wxyz of (N, 3, 3) rotations: each is the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    found = []
    for m in turns:
        across = torch.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
        trace = m.trace()
        table = torch.zeros(4, 4).double()
        table[0, 0], table[0, 1:], table[1:, 0] = trace, across, across
        table[1:, 1:] = m + m.T - trace * torch.eye(3).double()
        found.append(torch.linalg.eigh(table).eigenvectors[:, -1])
    return torch.stack(found)


def antialias(kind: str, degree: int, seed: int):
    """Gaussians of all sizes, their opacity lowered by what the dilation adds."""
    small, view = plain(kind, degree, seed, size=0.3)
    return Splats(kind, *small.tensors().values(), antialias=True), view


def undilated(kind: str, degree: int, seed: int):
    """The same with hardly any dilation, as in Mip-Splatting."""
    return replace(antialias(kind, degree, seed)[0], dilation=0.1), plain(kind, degree, seed, size=0.3)[1]


SCENES: dict[str, Callable[[str, int, int], tuple[Splats, Camera]]] = {
    maker.__name__: maker
    for maker in (plain, needle, huge, tiny, around, opaque, faint, grazing, edge_on, antialias, undilated)
}
FOR_GAUSSIANS = ("antialias", "undilated")
CASES = [
    (name, kind)
    for kind in (*PRIMITIVE_KINDS, "plane", "ray", "solid")
    for name in SCENES
    if name not in FOR_GAUSSIANS or kind in ("gaussian", "plane")
]
"""Scene and kind, or geometry of gaussians; some say nothing about surfels and rays."""


def make(name: str, kind: str, degree: int | None = None, seed: int = 3) -> tuple[Splats, Camera]:
    """A scene by name, of a kind or of gaussians with a geometry; without a degree, one that differs by scene."""
    degree = list(SCENES).index(name) % 4 if degree is None else degree
    if kind in PRIMITIVE_KINDS:
        return SCENES[name](kind, degree, seed)
    made, view = SCENES[name]("gaussian", degree, seed)
    if name == "tiny" and kind in ALONG_RAYS:  # nothing widens them: no pixel would see smaller ones
        made = replace(made, scales=10 * made.scales)
    return replace(made, geometry=kind), view


def double(drawn: Splats) -> Splats:
    """The same splats in float64."""
    return replace(drawn, **{name: t.detach().double() for name, t in drawn.tensors().items()})


def leaves(drawn: Splats) -> Splats:
    """The same splats in float64, each tensor a leaf that wants a gradient."""
    return replace(drawn, **{name: t.detach().double().requires_grad_() for name, t in drawn.tensors().items()})


def crop(view: Camera, width: int, height: int, left: int = 0, top: int = 0) -> Camera:
    """A window of the camera's image."""
    return replace(view, cx=view.cx - left, cy=view.cy - top, width=width, height=height)


def rows(drawn: Splats, which: slice | Tensor) -> Splats:
    """Some of the splats."""
    return drawn.take(which)
