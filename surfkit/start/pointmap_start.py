"""Initial points from pointmaps: a 3D point for every pixel, as networks that look at several photographs give them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from surfkit.core.check import BadInput, few, require_within
from surfkit.core.events import Progress, Warned, emit
from surfkit.depth.consistency import agreement
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.primitives.base import Primitive
from surfkit.primitives.init import gaps
from surfkit.scene.camera import Camera
from surfkit.scene.photo_names import safe_path
from surfkit.scene.scene import Scene, SparsePoints
from surfkit.start.base import Start, StartInput
from surfkit.start.depth_points import points_of
from surfkit.start.voxels import VoxelAccumulator, thin_to

DRAWS = 300
"""Similarities through three points that are tried for a photograph (RANSAC, Fischler and Bolles 1981)."""
MIN_AGREEING, MIN_AGREEING_SHARE = 12, 0.3
"""Sparse points that a similarity must agree with, and their share of those that lie in the photograph: the others may
be hidden there, or wrong."""
NEAR_VIEWS = 12
"""Photographs, those with the nearest cameras, whose pointmaps may confirm the points of one."""
FIRST_VOXEL_SHARE = 1e-3
"""Side of the voxels that points are gathered in, as a share of the extent of the points; thinning enlarges it."""


@dataclass(frozen=True)
class PointmapStart(Start):
    """Start from pointmaps, as of DUSt3R, MASt3R or VGGT; MetroGS (CVPR 2026) starts from some too.

    The points of each photograph are moved to the sparse points by a similarity of their own, found by RANSAC, as the
    frame of a pointmap may be any. They stay where they lie on the ray of their pixel in the known camera, are among
    the confident ones, and the pointmap of another photograph agrees. What is left is thinned evenly. How pointmaps are
    aligned and which points stay is of our own.
    """

    maps: str = ""
    """Folder of pointmaps, NAME.npz or NAME.npy for the photograph NAME, such as a.jpg.npz; the shape is that of the
    photograph, at any size. A .npy holds points, (h, w, 3); an .npz has them as `points`, and may have `confidence`,
    (h, w), higher where a point is more certain."""

    points: int = 500_000
    """Most points."""

    unsure: float = 0.3
    """Share of the pixels of each pointmap, those of the lowest confidence, that are left out."""

    tolerance: float = 0.02
    """Largest distance to sparse points and to the pointmaps of other photographs, as a share of the depth."""

    off_ray: float = 0.01
    """Largest distance of a point from the ray of its pixel, as a share of its depth."""

    opacity: float = 0.5
    """Initial opacity."""

    def __post_init__(self) -> None:
        require_within({"points": (1, 10**9), "tolerance": (1e-6, 1), "off_ray": (1e-6, 1)}, self)
        if not (0 <= self.unsure < 1 and 0 < self.opacity < 1):
            raise BadInput("start.unsure must be from 0 to below 1, and start.opacity between 0 and 1")

    @property
    def is_dense(self) -> bool:
        """See `Start.is_dense`."""
        return True

    @property
    def most_points(self) -> int:
        """See `Start.most_points`."""
        return self.points

    def limited(self, points: int) -> PointmapStart:
        """See `Start.limited`."""
        return replace(self, points=min(self.points, points))

    def expected(self, sparse: int, pixels: int) -> int:
        """See `Start.expected`."""
        return self.points

    def files(self) -> tuple[Path, ...]:
        """See `Start.files`."""
        return tuple(sorted(path for path in Path(self.maps).rglob("*.np[yz]"))) if self.maps else ()

    def refuse_unfit(self, primitive: Primitive, scene: Scene) -> None:
        """See `Start.refuse_unfit`."""
        if not self.maps or not Path(self.maps).is_dir():
            raise BadInput(f"start.maps is {self.maps!r}; name the folder of the pointmaps, with NAME.npz or NAME.npy")

    def cloud(self, known: StartInput) -> SparsePoints:
        """See `Start.cloud`."""
        depths, unfit = self.depths(known)
        if unfit:
            emit(Warned(f"the pointmaps of {few(unfit)} are missing or fit no similarity to the sparse points"))
        if not depths:
            raise BadInput(f"{self.maps}: no pointmap of these photographs fits the sparse points")
        views = known.scene.train
        centres = torch.stack([view.camera.centre for view in views])
        side = FIRST_VOXEL_SHARE * float(np.ptp(known.scene.cloud.xyz.numpy(), axis=0).max())
        collected = VoxelAccumulator.for_points(side, self.points)
        for count, (at, (camera, inverse)) in enumerate(depths.items(), 1):
            near = (centres - centres[at]).norm(dim=1).argsort()[1 : NEAR_VIEWS + 1].tolist()
            others = [depths[other] for other in near if other in depths]
            there = (inverse > 0) & (agreement(camera, inverse, others, self.tolerance).agreeing >= 1)
            with suppress(BadInput):  # a damaged photograph: training passes over it too, and tells
                photo = interpolate(known.photos[at][None].float(), inverse.shape, mode="area")[0]
                mask = None if known.masks is None else known.masks[at]
                if mask is not None:
                    there &= interpolate(mask[None, None].float(), inverse.shape, mode="area")[0, 0] == 1
                prior = DepthPrior(inverse, there.float(), 1.0)
                collected.add(points_of(camera, prior, photo, there))
            emit(Progress("points of pointmaps", count, len(depths)))
        found = thin_to(collected.settle(), self.points)
        if not len(found):
            raise BadInput(f"{self.maps}: no point of a pointmap is confirmed by that of another photograph")
        xyz = torch.from_numpy(found.xyz).float()
        return SparsePoints(
            xyz=xyz,
            rgb=torch.from_numpy(found.rgb.round().clip(0, 255)).to(torch.uint8),
            normals=torch.from_numpy(found.normals).float(),
            opacity=torch.full((len(xyz),), self.opacity),
            size=gaps(xyz),
        )

    def depths(self, known: StartInput) -> tuple[dict[int, tuple[Camera, Tensor]], list[str]]:
        """Cameras and (h, w) inverse depths, 0 for none, by position of the view; names of photographs without."""
        found: dict[int, tuple[Camera, Tensor]] = {}
        unfit, xyz = [], known.scene.cloud.xyz.double().numpy()
        for at, view in enumerate(known.scene.train):
            pointmap = read_pointmap(Path(self.maps), view.name)
            if pointmap is not None:
                points, confidence = pointmap
                camera = view.camera.resized(points.shape[1], points.shape[0])
                pose = camera.world_to_camera.numpy()
                fit = self.similarity(points, camera, xyz @ pose[:3, :3].T + pose[:3, 3])
                if fit is not None:
                    found[at] = camera, self.inverse(points, confidence, camera, fit)
                    continue
            unfit.append(view.name)
        return found, unfit

    def similarity(self, points: np.ndarray, camera: Camera, local: np.ndarray) -> np.ndarray | None:
        """(3, 4) from the frame of a pointmap (h, w, 3) to that of its camera, where sparse points are (P, 3)."""
        local = local[local[:, 2] > 0]
        x = np.floor(local[:, 0] / local[:, 2] * camera.fx + camera.cx)
        y = np.floor(local[:, 1] / local[:, 2] * camera.fy + camera.cy)
        inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        theirs, ours = points[y[inside].astype(int), x[inside].astype(int)].astype(np.float64), local[inside]
        usable = np.isfinite(theirs).all(1)
        theirs, ours = theirs[usable], ours[usable]
        if len(ours) < MIN_AGREEING:
            return None
        draw, best = np.random.default_rng(0), np.zeros(len(ours), bool)
        for _ in range(DRAWS):
            three = draw.choice(len(ours), 3, replace=False)
            agrees = self.agrees(umeyama(theirs[three], ours[three]), theirs, ours)
            best = agrees if agrees.sum() > best.sum() else best
        if best.sum() < max(MIN_AGREEING, MIN_AGREEING_SHARE * len(ours)):
            return None
        for _ in range(2):
            best = self.agrees(umeyama(theirs[best], ours[best]), theirs, ours)
            if best.sum() < MIN_AGREEING:
                return None
        return umeyama(theirs[best], ours[best])

    def agrees(self, fit: np.ndarray, theirs: np.ndarray, ours: np.ndarray) -> np.ndarray:
        """(K,) bool, whether points come close to where they should."""
        return np.linalg.norm(theirs @ fit[:, :3].T + fit[:, 3] - ours, axis=1) <= self.tolerance * ours[:, 2]

    def inverse(self, points: np.ndarray, confidence: np.ndarray | None, camera: Camera, fit: np.ndarray) -> Tensor:
        """(h, w) float32 inverse depth of the points that stay, 0 elsewhere."""
        moved = torch.from_numpy(points.astype(np.float64) @ fit[:, :3].T + fit[:, 3]).permute(2, 0, 1)
        depth = moved[2]
        off = (moved - camera.rays(torch.float64) * depth).norm(dim=0)
        keep = torch.isfinite(moved).all(0) & (depth > 0) & (off <= self.off_ray * depth)
        if confidence is not None:
            keep &= torch.from_numpy(confidence >= np.nanquantile(confidence, self.unsure))
        return torch.where(keep, 1 / depth.clamp_min(1e-12), 0).float()


def read_pointmap(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray | None] | None:
    """(h, w, 3) points of a photograph and (h, w) confidence, if there is one; None where it has no file.

    Raises:
        BadInput: The file holds something else.
    """
    stem = folder / safe_path(name)
    for path in (stem.with_name(f"{stem.name}.npz"), stem.with_name(f"{stem.name}.npy")):
        if not path.is_file():
            continue
        try:
            stored = np.load(path, allow_pickle=False)
            parts = {"points": stored} if isinstance(stored, np.ndarray) else dict(stored)
        except Exception as error:  # of a damaged file, zipfile and numpy raise whatever comes
            raise BadInput(f"{path}: cannot be read: {' '.join(str(error).split())}") from error
        points, confidence = parts.get("points"), parts.get("confidence")
        if points is None or points.ndim != 3 or points.shape[2] != 3 or points.dtype.kind != "f" or not points.size:
            what = "no `points`" if points is None else f"{points.dtype} of shape {points.shape}"
            raise BadInput(f"{path}: it has {what}; a pointmap is floats of (height, width, 3)")
        if confidence is not None and (confidence.shape != points.shape[:2] or confidence.dtype.kind not in "biuf"):
            raise BadInput(
                f"{path}: confidence is {confidence.dtype} of shape {confidence.shape}, and points have shape "
                f"{points.shape}; it must have a number for each point"
            )
        return points, confidence
    return None


def umeyama(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(3, 4) the similarity that moves (K, 3) points closest to (K, 3) others (Umeyama 1991, eq. 40 to 42)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    scale = (s * sign).sum() / max((a**2).sum(), 1e-300)
    turn = scale * (u * sign) @ vt
    return np.column_stack([turn, target.mean(0) - turn @ source.mean(0)])
