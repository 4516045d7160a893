"""One repetition of a comparison: points drawn, aligned, cropped and thinned, and the distances between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.memory import size
from surfkit.evaluate.geometry.registration import IcpResult, align
from surfkit.evaluate.geometry.sampling import face_areas, sample_surface
from surfkit.evaluate.geometry.scores import WORKERS, Distances, nearest, tree
from surfkit.evaluate.geometry.surface_file import SurfaceFile, part_within, rounding
from surfkit.evaluate.geometry.thinning import thin, voxel_for
from surfkit.evaluate.geometry.transform import apply, scale_of
from surfkit.evaluate.geometry.volume import extent_text
from surfkit.io.area import Area
from surfkit.scene.available_memory import free_bytes
from surfkit.scene.crop import Crop

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

MAX_COMPARED_POINTS = 4_000_000
"""Points of a cloud or of a mesh that are compared; larger clouds are thinned to about as many while they are read."""
MAX_ICP_POINTS = 400_000
"""Points of the reconstruction that ICP thins and looks at: many more than seven numbers need."""
MAX_MISSED_POINTS = 100_000
"""Points of the truth by which alignments are compared."""
MIN_ALIGNMENT_GAIN = 0.02
"""Share by which another alignment must leave less of the truth uncovered than the usual one, to take its place."""
UNTOLD_SIZE = 1e-3
"""Change of size by ICP that is taken as it is; a larger one must gain."""
MIN_COMPARED_POINTS = 10
"""Points on either side without which shares mean nothing."""
MAX_ROUNDING_TAUS = 0.25
"""Step between coordinates, as a share of tau, up to which rounding decides nothing."""
SAMPLE_BYTES = 200
"""Memory for a point that is drawn from a mesh; as much again for one of the other side."""
Box = tuple[np.ndarray, np.ndarray]
"""(3,) least and (3,) greatest coordinates."""
MIN_EXTENT_RATIO = 0.1
"""Of the truth's extent: a reconstruction smaller than this has another unit."""


@dataclass(frozen=True)
class ComparedSurface:
    """The reconstruction or the truth, from which points can be drawn.

    Attributes:
        surface: The file.
        cloud: (n, 3) its points, thinned if there were too many; None for a mesh.
        count: Points that a draw from a mesh has.
        voxel: By which the cloud was thinned, or None.
        sparse: Samples of a mesh that would be needed, where it gets fewer.
    """

    surface: SurfaceFile
    cloud: np.ndarray | None
    count: int
    voxel: float | None = None
    sparse: int | None = None

    def points(self, draw: np.random.Generator) -> np.ndarray:
        """(n, 3) float64: of a mesh, new ones with every draw."""
        return sample_surface(self.surface, self.count, draw) if self.cloud is None else self.cloud


@dataclass(frozen=True)
class RepetitionResult:
    """One repetition of the measurement.

    Attributes:
        reconstruction: (n, 3) points inside the crop volume, thinned, frame of the truth.
        truth: (m, 3) likewise.
        distances: Between them.
        alignment: By which they were brought together.
    """

    reconstruction: np.ndarray
    truth: np.ndarray
    distances: Distances
    alignment: IcpResult


def cloud_side(surface: SurfaceFile, voxel: float | None) -> ComparedSurface:
    """A cloud that is read, and thinned, now; larger ones than `MAX_COMPARED_POINTS` also if no voxel is given."""
    if voxel is None and len(surface) <= MAX_COMPARED_POINTS:
        return ComparedSurface(surface, np.concatenate(list(surface.blocks())), len(surface))
    if voxel is None:
        voxel = voxel_for(surface.blocks, MAX_COMPARED_POINTS)
        emit(Warned(f"{surface.path}: {len(surface)} points, thinned to one in each voxel of {voxel:.3g}"))
    cloud = thin(surface.blocks(), voxel, next(block[0] for block in surface.blocks() if len(block)))
    return ComparedSurface(surface, cloud, len(cloud), voxel)


def mesh_side(surface: SurfaceFile, count: int | None, tau: float, box: Box | None = None) -> ComparedSurface:
    """A mesh, of which as many points are drawn as it has vertices and faces, as the paper does.

    A coarse mesh gets more, so that they lie no further apart than 0.7 tau: right surfaces would count as missing.
    Where these are too many, they are drawn in the box alone: a few large triangles far away, such as a sky, would
    take them all.

    Args:
        surface: The mesh.
        count: Of points; None for the number above.
        tau: Threshold, in units of the mesh.
        box: Its part that is compared, in the frame of the mesh; None for all of it.
    """
    sparse = None
    if count is None:
        area, least = float(face_areas(surface).sum()), len(surface) + len(surface.triangles)
        needed = _needed(area, tau)
        if (
            needed > max(least, MAX_COMPARED_POINTS)
            and box is not None
            and len((part := part_within(surface, *box)).triangles)
        ):
            inner = float(face_areas(part).sum())
            surface, needed, least = part, _needed(inner, tau), max(MIN_COMPARED_POINTS, int(least * inner / area))
        count = max(least, min(needed, MAX_COMPARED_POINTS))
        sparse = needed if count < needed else None
    free = free_bytes()
    if count * SAMPLE_BYTES > free:
        raise BadInput(
            f"{surface.path}: {count:,} samples take {size(count * SAMPLE_BYTES)}, and {size(free)} are free; give "
            f"--samples {max(MIN_COMPARED_POINTS, free // SAMPLE_BYTES // 2)} or less"
        )
    return ComparedSurface(surface, None, count, sparse=sparse)


def _needed(area: float, tau: float) -> int:
    """Samples of a surface with that area that lie 0.7 tau apart."""
    return int(2 * area / tau**2) + 1


def warn_if_sparse(side: ComparedSurface, tau: float) -> None:
    """Warn of samples of a mesh that lie too far apart."""
    if side.sparse is not None:
        emit(
            Warned(
                f"{side.surface.path}: its {side.count} samples lie further apart than 0.7 times tau ({tau:.3g}), so "
                f"right surfaces count as missing; give a larger --tau, a smaller --crop, or --samples {side.sparse}"
            )
        )


def warn_if_rounded(surface: SurfaceFile, tau: float) -> None:
    """Warn of coordinates, such as those of a map in a file of 32 bits, that are too far apart for the threshold."""
    if (step := rounding(surface)) > MAX_ROUNDING_TAUS * tau:
        emit(
            Warned(
                f"{surface.path}: its coordinates are numbers of 32 bits, at the largest ones {step:.3g} apart, "
                f"which is much for a tau of {tau:.3g}: take a file of 64 bits, or one near its origin, and --transform"
            )
        )


class Measurement:
    """One repetition: its random points and lattice, and what is computed from them.

    Args:
        ours: The reconstruction.
        theirs: The truth.
        crop: Volume, or None.
        tau: Threshold; points are thinned to half of it.
        draw: Of the points and of where the lattice of voxels begins.
        area: What counts of the volume, frame of the truth; None for all of it.
    """

    def __init__(
        self,
        ours: ComparedSurface,
        theirs: ComparedSurface,
        crop: Crop | None,
        tau: float,
        draw: np.random.Generator,
        area: Area | None = None,
    ) -> None:
        self.crop, self.area, self.tau, self.paths = crop, area, tau, (ours.surface.path, theirs.surface.path)
        target, self.offset = theirs.points(draw), draw.random(3)  # first: the same for every reconstruction
        self.source = ours.points(draw)
        self.target = self.cropped(target)
        self.spans = extent_text(self.source), extent_text(target)
        self.targets = cache(self._target)
        self.found: dict[tuple[bytes, bool], IcpResult] = {}

    def cropped(self, points: np.ndarray) -> np.ndarray:
        """Those in the crop volume and the area, of (n, 3) points in the frame of the truth."""
        for part in (self.crop, self.area):
            points = points if part is None else points[part.inside(points)]
        return points

    def thinned(self, points: np.ndarray, voxel: float) -> np.ndarray:
        """(m, 3) of (n, 3) points in the frame of the truth."""
        return thin([points], voxel, self.target[0] - self.offset * voxel)

    def _target(self, voxel: float) -> tuple[cKDTree, np.ndarray]:
        points = self.thinned(self.target, voxel)
        return tree(points), points

    def clouds(self, voxel: float, matrix: np.ndarray) -> tuple[np.ndarray, cKDTree, np.ndarray]:
        """What a round of ICP compares (`registration.Clouds`)."""
        few = self.source[:: max(1, len(self.source) // MAX_ICP_POINTS)]
        moved = self.thinned(self.cropped(apply(matrix, few)), voxel)
        return apply(np.linalg.inv(matrix), moved), *self.targets(voxel)

    def draw(self, start: np.ndarray, way: str) -> RepetitionResult | None:
        """Align in one way, and compare; None where that leaves too few points to compare."""
        found = IcpResult(start, 0.0, None) if way == "none" else self.aligned(start, way == "similarity")
        ours = self.thinned(self.cropped(apply(found.matrix, self.source)), self.tau / 2)
        there, theirs = self.targets(self.tau / 2)
        if min(len(ours), len(theirs)) < MIN_COMPARED_POINTS:
            return None
        distances = Distances(nearest(there, ours), nearest(tree(ours), theirs))
        if way == "none":
            near = distances.to_truth[distances.to_truth < 2 * self.tau]
            residual = float(np.sqrt((near**2).mean())) if len(near) else None
            found = IcpResult(start, len(near) / len(ours), residual)
        return RepetitionResult(ours, theirs, distances, found)

    def aligned(self, start: np.ndarray, with_scale: bool) -> IcpResult:
        """The alignment that leaves least of the truth uncovered, of ICP by all matches, by mutual ones, and of none.

        All matches lead astray where the reconstruction reaches beyond the truth: a smaller, or a shifted one has more
        of them. What the truth misses does not gain by that. The size changes only where that gains: noise alone lets
        ICP shrink.
        """
        if (start.tobytes(), with_scale) not in self.found:
            first = align(self.clouds, start, self.tau, with_scale)
            others = [align(self.clouds, start, self.tau, with_scale, mutual=True), IcpResult(start, 0.0, None)]
            if with_scale and abs(first.scale / scale_of(start) - 1) > UNTOLD_SIZE:
                others, first = [first, *others], self.aligned(start, with_scale=False)
            misses = {id(each): self.missed(each.matrix) for each in (first, *others)}
            best = min(others, key=lambda each: misses[id(each)])
            better = misses[id(best)] < (1 - MIN_ALIGNMENT_GAIN) * misses[id(first)]
            self.found[start.tobytes(), with_scale] = best if better else first
        return self.found[start.tobytes(), with_scale]

    def missed(self, matrix: np.ndarray) -> float:
        """Mean distance, tau at most, of the truth in the crop volume to a reconstruction in that place."""
        few = self.source[:: max(1, len(self.source) // MAX_ICP_POINTS)]
        there, (_, target) = tree(apply(matrix, few)), self.targets(self.tau / 2)
        target = target[:: max(1, len(target) // MAX_MISSED_POINTS)]
        away, _ = there.query(target, distance_upper_bound=self.tau, workers=WORKERS)
        return float(np.minimum(away, self.tau).mean())

    def refuse_other_frame(self, matrix: np.ndarray) -> None:
        """BadInput if the two cannot lie in one frame."""
        moved = self.cropped(apply(matrix, self.source))
        places = f"the reconstruction spans {self.spans[0]}, the truth {self.spans[1]}"
        remedy = "if frames or units differ, give --transform; if the crop volume is wrong, --crop"
        parts = ["the crop volume"] * (self.crop is not None) + ["--area"] * (self.area is not None)
        for points, what, path in zip((moved, self.target), ("reconstruction", "truth"), self.paths, strict=True):
            if len(points) < MIN_COMPARED_POINTS:
                where = f"inside {' and '.join(parts)}" if parts else "in all"
                raise BadInput(f"{path}: {len(points)} points of the {what} {where}; {places}; {remedy}")
        sizes = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in (moved, self.target)]
        if sizes[0] < MIN_EXTENT_RATIO * sizes[1]:
            raise BadInput(
                f"{self.paths[0]}: where they are compared, the reconstruction is {sizes[0]:.3g} across and the truth "
                f"{sizes[1]:.3g}: another unit? {places}; {remedy}"
            )
        gap = np.maximum(moved.min(0) - self.target.max(0), self.target.min(0) - moved.max(0)).max()
        if gap > 80 * self.tau:
            raise BadInput(
                f"{self.paths[1]}: the truth lies {gap:.3g} away from the reconstruction: {places}; {remedy}"
            )


def refuse_few(points: np.ndarray, path: Path, where: str = "") -> None:
    """BadInput if shares of so few points would mean nothing; `where` says which of the file they are."""
    if len(points) < MIN_COMPARED_POINTS:
        raise BadInput(f"{path}: {len(points)} points{where}; {MIN_COMPARED_POINTS} or more are needed to compare with")
