"""Small inputs for parts of each kind, the same ones at each call. All of them need torch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from surfkit.compress.levels.base import LodInput
from surfkit.densify.base import ComparedView, Contribution, Step
from surfkit.depth.base import DepthInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.io.datasets.read import observations, read
from surfkit.losses.base import Neighbour, Target
from surfkit.mesh.base import MeshInput
from surfkit.mesh.overlap import Depths
from surfkit.partition.base import CoarseModel
from surfkit.primitives.base import Primitive
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Points
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.raster.api import Maps, Splats
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.observations import Observations, Observations2D
from surfkit.scene.scene import Frame, SparsePoints, View
from surfkit.start.base import StartInput
from surfkit.testing.synthetic import Flight, Synthetic, photograph, write_colmap

BALL_RADIUS = 0.5
"""Of the ball of `mesh_input`, local units."""


def cloud(count: int = 50) -> SparsePoints:
    """Random coloured points in the unit cube."""
    draw = torch.Generator().manual_seed(0)
    xyz = torch.rand(count, 3, generator=draw)
    return SparsePoints(xyz, torch.randint(0, 256, (count, 3), generator=draw, dtype=torch.uint8))


def splats(kind: str = "surfel", count: int = 60) -> Splats:
    """Random splats of spherical harmonics of degree 1."""
    draw = torch.Generator().manual_seed(0)
    scales = 0.01 + 0.05 * torch.rand(count, 2 if kind == "surfel" else 3, generator=draw)
    quats = normalize(torch.randn(count, 4, generator=draw), dim=1)
    opacities = 0.05 + 0.9 * torch.rand(count, generator=draw)
    means, sh = torch.rand(count, 3, generator=draw), torch.randn(count, 4, 3, generator=draw)
    return Splats(kind, means, quats, scales, opacities, sh[:, :1], sh[:, 1:])


@dataclass(frozen=True)
class KnownViews:
    """Answers of twenty views about points of known contribution (`densify.base.Views`).

    Attributes:
        contribution: (N,) in [0, 1]; no view sees points with 0.
    """

    contribution: Tensor

    def __len__(self) -> int:
        return 20

    def contributions(self, alpha_power: float = 0.5, transmittance_power: float = 0.5) -> Contribution:
        """See `Views.contributions`."""
        seen = (self.contribution > 0).long()
        return Contribution(self.contribution**alpha_power, self.contribution**alpha_power, 50 * seen, 10 * seen)

    def leading(self, at: Sequence[int] | None = None) -> Tensor:
        """See `Views.leading`; up to 2 pixels of each view."""
        return (2 * self.contribution).round().long() * (len(self) if at is None else len(at))

    def each(self, alpha_power: float, transmittance_power: float) -> Iterator[tuple[Tensor, Tensor]]:
        """See `Views.each`."""
        for at in range(len(self)):
            yield 40 * self.contribution.roll(at) ** alpha_power, (50 * (self.contribution > 0)).long()


def crowd(count: int = 200) -> tuple[Points, Step]:
    """Random surfels in the unit cube, some of them large, and step 1,000 of 30,000 about them."""
    draw = torch.Generator().manual_seed(0)
    params = Surfel2D().init(
        SparsePoints(torch.rand(count, 3, generator=draw), torch.zeros(count, 3, dtype=torch.uint8)), draw
    )
    contribution, picture = torch.rand(count, generator=draw), torch.Generator().manual_seed(1)
    color, photo = (torch.rand(3, 12, 16, generator=picture) for _ in range(2))
    step = Step(
        index=1_000,
        steps=30_000,
        seen=torch.rand(count, generator=draw) > 0.3,
        splats=Surfel2D().activate(params, 3),
        grad_norm=4e-4 * torch.rand(count, generator=draw),
        radii=50 * torch.rand(count, generator=draw),
        image_px=800,
        views=KnownViews(contribution),
        since_reset=1_000,
        rates={"means": 1e-4},
        seed=1,
        signed_norm=4e-4 * torch.rand(count, generator=draw),
        view=ComparedView(color, photo, lambda values: values.sum() * contribution / count),
    )
    return Points.fresh(params), step


def maps(alpha: Tensor, reads: Iterable[str], draw: torch.Generator) -> Maps:
    """Random maps that fit together, of the names in `reads`; all 0 where (H, W) `alpha` is."""
    depth = 1 + torch.rand(alpha.shape, generator=draw)
    normal = normalize(torch.randn(3, *alpha.shape, generator=draw), dim=0)
    everything = {
        "color": alpha * torch.rand(3, *alpha.shape, generator=draw),
        "alpha": alpha,
        "depth": alpha * depth,
        "median": torch.where(alpha > 0.5, depth, 0.0),
        "normal": alpha * normal,
        "distortion": alpha**2 * 0.01,
    }
    return Maps(**{name: everything[name].detach().clone() for name in reads})


def target(size: tuple[int, int], draw: torch.Generator) -> Target:
    """A random photograph of (H, W) pixels with a depth prior, normals and a neighbour."""
    height, width = size
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, width / 2, height / 2, width, height)
    view, photo = View("random.png", camera, Path("random.png")), torch.rand(3, *size, generator=draw)
    there = torch.rand(size, generator=draw) > 0.2
    inverse = torch.where(there, 0.5 + torch.rand(size, generator=draw), 0.0)
    normal = there * normalize(torch.randn(3, *size, generator=draw), dim=0)
    prior = DepthPrior(inverse, torch.rand(size, generator=draw) * there, 0.8, normal)
    beside = camera.world_to_camera.clone()
    beside[0, 3] = 0.02  # less than a pixel of parallax, at any depth
    view_beside = View("beside.png", replace(camera, world_to_camera=beside), Path("beside.png"))
    of_it = maps(torch.ones(size), ("alpha", "depth", "median", "normal"), draw)
    return Target(view, photo, prior, neighbour=Neighbour(view_beside, torch.rand(3, *size, generator=draw), of_it))


def survey(views: int = 9, width: int = 64, height: int = 48, points: int = 400) -> Synthetic:
    """An aerial grid of photographs over a box and a ball, none of them held out, and all that is true of it."""
    return photograph(Flight(kind="grid", views=views, width=width, height=height, points=points, test_every=0))


def exact_priors(synthetic: Synthetic) -> list[DepthPrior]:
    """The true depths and normals of the training views."""
    priors = []
    for view in synthetic.scene.train:
        exact = synthetic.exact[view.name]
        inverse = torch.where(exact.depth > 0, 1 / exact.depth, 0).float()
        priors.append(DepthPrior(inverse, (inverse > 0).float(), 0.7, exact.normal.float()))
    return priors


def start_input(priors: bool = True) -> StartInput:
    """What a start is given: a survey of exact depth priors, one of them missing, or without any."""
    truth = survey()
    photos = [(truth.exact[view.name].color * 255).round().to(torch.uint8) for view in truth.scene.train]
    known = [None, *exact_priors(truth)[1:]] if priors else None
    return StartInput(truth.scene, photos, None, known, torch.Generator().manual_seed(0))


def depth_input(folder: Path) -> tuple[DepthInput, Synthetic]:
    """What an estimator of depth is given, from files that are written to a folder, and all that is true of it."""
    truth = survey(views=9, width=72, height=54, points=600)
    write_colmap(folder / "data", truth, tracks=True)
    data = Data(folder / "data", test_every=0)
    scene, work = read(data), folder / "work"
    work.mkdir(exist_ok=True)
    return DepthInput(scene.train, observations(data, scene), torch.device("cpu"), work), truth


def exact_depths(synthetic: Synthetic) -> tuple[Depths, list[Maps]]:
    """True depth maps of the training views, and what a perfect model would draw."""
    exact = [synthetic.exact[view.name] for view in synthetic.scene.train]
    drawn = [
        Maps(e.color.float(), (e.depth > 0).float(), e.depth.float(), e.depth.float(), e.normal.float()) for e in exact
    ]
    return Depths([view.camera for view in synthetic.scene.train], lambda at: drawn[at].need("depth").clone()), drawn


def above(x: float, y: float, height: float = 0.5) -> Camera:
    """A camera that looks straight down."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, y, height], dtype=torch.float64)
    return Camera(pose, 50.0, 50.0, 24.0, 20.0, 48, 40)


def coarse_model(count: int = 1_500, seed: int = 0) -> CoarseModel:
    """Discs on the ground, denser to the left, and 6 x 5 cameras above them."""
    draws = torch.Generator().manual_seed(seed)
    xy = torch.rand(count, 2, generator=draws) * 2 - 1
    xy[:, 0] = 2 * ((xy[:, 0] + 1) / 2) ** 2 - 1
    means = torch.cat([xy, 0.02 * torch.rand(count, 1, generator=draws)], 1)
    color = torch.rand(count, 1, 3, generator=draws) * 2 - 1
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous()
    discs = Splats("surfel", means, quats, torch.full((count, 2), 0.025), torch.full((count,), 0.9), color)
    at = [(-0.8 + 1.6 * i / 5, -0.8 + 1.6 * j / 4) for j in range(5) for i in range(6)]
    views = tuple(View(f"{i:02}.png", above(*xy), Path(f"{i:02}.png")) for i, xy in enumerate(at))
    return CoarseModel(discs, views, select("cpu")[0], 0.01, observations=_shown(means, views))


def _shown(points: Tensor, views: Sequence[View]) -> Observations:
    """All of (P, 3) points that lie in the picture of each view, as a sparse model has them."""
    seen = {}
    for view in views:
        x, y, z = (points.double() @ view.camera.world_to_camera[:3, :3].T + view.camera.world_to_camera[:3, 3]).T
        size = torch.tensor([view.camera.width, view.camera.height])
        at = torch.stack([view.camera.fx * x / z + view.camera.cx, view.camera.fy * y / z + view.camera.cy], 1) / size
        rows = ((z > 0) & ((at >= 0) & (at <= 1)).all(1)).nonzero()[:, 0]
        seen[view.name] = Observations2D(rows.numpy(), at[rows].numpy())
    return Observations(points.double().numpy(), np.zeros(len(points)), seen)


def lod_input(primitive: Primitive | None = None, count: int = 400) -> LodInput:
    """A model of a survey, as it is before its first step, and the cameras; its folder is not there.

    Args:
        primitive: What it is made of; surfels of degree 1 if None.
        count: Sparse points of the survey.
    """
    truth, primitive = survey(points=count), primitive or Surfel2D(sh_degree=1)
    params = primitive.init(truth.scene.cloud, torch.Generator().manual_seed(0))
    model = SplatModel(primitive, params, primitive.sh_degree)
    return LodInput(model, truth.scene.train, select("cpu")[0], truth.scene.frame, 0, Path("levels"))


def mesh_input(kind: str = "surfel", count: int = 900, views: int = 14, **changes: Any) -> MeshInput:
    """Splats on a ball, opaque and red, and cameras all around it, with depth priors and photographs of it.

    Args:
        kind: Of splats.
        count: Of splats.
        views: How many.
        changes: Other values of the fields.
    """
    normals = _evenly(count)
    scales = torch.full((count, 2 if kind == "surfel" else 3), 0.03)
    if kind == "gaussian":
        scales[:, 2] = 0.002
    sh = torch.tensor([1.0, -1.0, -1.0]).expand(count, 1, 3).contiguous() / 0.2821 / 2
    ball = Splats(kind, (BALL_RADIUS * normals).float(), _facing(normals), scales, torch.full((count,), 0.95), sh)
    rasterizer, _ = select("cpu")
    seen = tuple(View(f"{i}", _towards_origin(2.0 * at), Path(f"{i}")) for i, at in enumerate(_evenly(views)))

    def draw_of(splats: Splats) -> Callable[[View], Maps]:
        return lambda view: rasterizer.render(splats, view.camera, 0.01, True, False).maps

    draw = draw_of(ball)
    drawn = [draw(view) for view in seen]
    medians = [m.need("median") for m in drawn]
    inverses = [torch.where(depth > 0, 1 / depth.clamp_min(1e-9), 0.0) for depth in medians]
    priors = [DepthPrior(i, (i > 0).float(), 1.0, m.normal) for i, m in zip(inverses, drawn, strict=True)]
    photos = [(m.need("color").clamp(0, 1) * 255).round().to(torch.uint8) for m in drawn]
    given = MeshInput(ball, seen, draw, rasterizer, 0.01, Frame(np.zeros(3), 1.0), 1 << 30)
    known: dict[str, Any] = {"priors": priors, "photo": photos.__getitem__, "draw_of": draw_of}
    return replace(given, **(known | changes))


def _evenly(count: int) -> Tensor:
    """(count, 3) float64 unit vectors, evenly spread."""
    at = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * at + 1) / count
    turn = at * np.pi * (3 - 5**0.5)
    side = (1 - z * z).sqrt()
    return torch.stack([side * turn.cos(), side * turn.sin(), z], 1)


def _towards_origin(centre: Tensor, size: int = 96) -> Camera:
    z = -centre / centre.norm()
    x = torch.linalg.cross(torch.tensor([0.31, 0.95, 0.05]).double(), z)
    x = x / x.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return Camera(pose, 1.2 * size, 1.2 * size, size / 2, size / 2, size, size)


def _facing(normals: Tensor) -> Tensor:
    """(N, 4) float32 quaternions that turn the z axis to unit vectors."""
    w = 1 + normals[:, 2]
    return torch.stack([w, -normals[:, 1], normals[:, 0], torch.zeros_like(w)], 1).float()
