"""A closed surface between what views see through and what they do not: votes, and the cut that costs least.

Labatut, Pons and Keriven (2009): points are tetrahedralised, what the cameras see votes which tetrahedra are empty and
which are full, and the surface is the minimum cut between both. Jancosek and Pajdla (2011): where few votes are, as on
walls in the shade, they still decide. Votes are the depth maps' own, asked for at places in space, and not rays of
single points: a depth map also knows what it sees between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.registry import choice
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.cut_tiles import LAST, UNDECIDED, DecidedTetrahedra, TetraTile, tiles
from surfkit.mesh.delaunay import Tetrahedra, tetrahedralised
from surfkit.mesh.fusion_image import Which
from surfkit.mesh.fusion_lengths import look, with_unit
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.holes import close_holes
from surfkit.mesh.manifold import apart, separated
from surfkit.mesh.oversampling import oversampled
from surfkit.mesh.oversized import without_oversized
from surfkit.mesh.refine_vertices import adjusted
from surfkit.mesh.sky import may_show_sky, without_sky
from surfkit.mesh.support import supported
from surfkit.mesh.surface_points import SurfacePoints, gather
from surfkit.mesh.trust import Trust
from surfkit.mesh.view_observations import ObservationSettings, ViewObservations, boxes_of, for_all, seen
from surfkit.mesh.vote_points import SHELL_DEPTH, places_of
from surfkit.raster.native import kernels, lacking, module
from surfkit.scene.lengths import Length, check_length, to_local
from surfkit.scene.scene import Frame, View
from surfkit.scene.up_direction import up_of_views

OUTWARD = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])
"""Corners of the face opposite to each corner of a positively oriented tetrahedron, counter-clockwise from outside."""
MIN_DEPTH_CONFIDENCE = 0.25
"""Confidence of a prior from which its depth counts."""
TETRA_POINT_BYTES = 2_000
"""Memory that a point takes, with its tetrahedra and the places in these."""
CELL_BYTES = 500
"""Memory that a cell takes while points are gathered."""
HALO = 100.0
"""Cells around a tile whose points it has too."""
MAX_CRACK_EDGES = 12
"""Edges of holes that are closed: where tiles meet, a large tetrahedron may have been divided in two ways."""
MIN_TETRA_POINTS = 4
CAMERA_CELL_VOLUME = 1e3
"""Volume that a camera stands for in the tetrahedron that holds it, cells."""


LIMITS = (
    ("cell_px", 0.1, 100),
    ("oversampling", 0.1, 8),
    ("largest_px", 0, 1e6),
    ("doubted", 0, 1),
    ("stereo", 0, 100),
    ("least_weight", 0, 1000),
    ("flat", 0, 1),
    ("noise_px", 0.01, 100),
    ("noise", 0, 0.1),
    ("thickness", 1, 100),
    ("area", 0.001, 1000),
    ("aligned", 0, 1),
    ("certain", 0.001, 1000),
    ("sure", 0.001, 1),
    ("hidden", 0, 10),
    ("damping", 0.001, 1000),
    ("least_views", 1, 100),
    ("guesses", 0, 1e6),
    ("smooth", 0.001, 1000),
)
"""Of the numbers of `Visibility`: the least and the most."""


@dataclass(frozen=True)
class Visibility(Mesher):
    """The surface that separates what views see through from what they do not, closed where something was seen."""

    cell: Length = "auto"
    """Side of the cells in which depth is averaged to points, metres; auto is `cell_px` pixels at the median depth."""

    cell_px: float = 1.3
    """Side of the cells in pixels at the median depth where it is auto."""

    depth_limit: Length = "auto"
    """Depth beyond which pixels do not count, metres; auto as in mesh:tsdf."""

    depth: Which = "median"
    """Depth of a pixel, as in mesh:tsdf."""

    oversampling: float = 1.0
    """Pixels of a depth map for each pixel in a row of the photograph, as in mesh:tsdf."""

    largest_px: float = 64.0
    """Leave out splats with a larger standard deviation, in pixels at the median depth, where splats are drawn; 0 keeps
    all."""

    sky: bool = False
    """Let the sky count too, as in mesh:tsdf."""

    trust: Annotated[Trust, choice(Trust)] = field(
        default_factory=partial(GeometricConsistency, alone=0.5, covered_by=2)
    )
    """How far the depth of a pixel that is drawn is trusted."""

    doubted: float = 0.05
    """Weight of depth that no other view confirms."""

    stereo: float = 2.0
    """Weight of stereo depth at full confidence, where there is some; drawn depth has 1. 0 leaves it out."""

    least_weight: float = 0.5
    """Sum of the weights of the pixels in a cell that has a point."""

    flat: float = 0.25
    """Points become one for eight cells, or 64, where they lie this near to a plane, in cells; 0 keeps all."""

    noise_px: float = 0.75
    """Standard deviation of a depth, in widths of a pixel there."""

    noise: float = 0.0005
    """What is added to it, as a share of the depth."""

    thickness: float = 2.0
    """Standard deviations behind a depth that it votes for as full: thin walls have two sides."""

    area: float = 1.0
    """What an area costs against the volumes that votes contradict: more gives a smoother surface."""

    aligned: float = 0.3
    """Share of that cost where a face lies as the normals of its points."""

    certain: float = 1.0
    """Sum of the votes at which half of the cost of a face is left: where many views look, they decide."""

    sure: float = 0.1
    """Share of the cost that is left in any case."""

    hidden: float = 0.1
    """Vote for full of what no view looks at."""

    damping: float = 0.25
    """Sum of votes at which they count half."""

    least_views: int = 2
    """Photographs that must confirm a place on the surface."""

    guesses: float = 48.0
    """Width up to which gaps that fewer confirm are closed, cells. 0 leaves them open, a large number keeps all."""

    smooth: float = 1.0
    """Weight of the faces around a vertex, where 1 is that of a pixel that is fully trusted, when vertices are moved to
    where the depth maps have them; more is smoother."""

    def __post_init__(self) -> None:
        for name in ("cell", "depth_limit"):
            check_length(f"mesh.{name}", getattr(self, name))
        for name, low, high in LIMITS:
            if not low <= getattr(self, name) <= high:
                raise BadInput(f"mesh.{name} is {getattr(self, name):g}; it must be from {low:g} to {high:g}")

    @property
    def needs_prior(self) -> bool:
        """See `Mesher.needs_prior`."""
        return not self.sky or self.stereo > 0 or self.trust.needs_prior

    def needs_prior_of(self, views: Sequence[View], frame: Frame) -> bool:
        """See `Mesher.needs_prior_of`."""
        wanted = self.stereo > 0 or self.trust.needs_prior
        return wanted or (not self.sky and may_show_sky(views, up_of_views(views, frame)))

    def refuse_unfit(self, frame: Frame) -> None:
        """See `Mesher.refuse_unfit`."""
        for name in ("cell", "depth_limit"):
            to_local(getattr(self, name), frame, f"mesh.{name}: ")

    def ready(self) -> None:
        """See `Mesher.ready`."""
        if module() is None:
            raise BadInput(f"mesh:visibility needs the compiled kernels: {lacking()}, or use mesh:tsdf")

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        self.ready()
        if not len(subject.splats) or not subject.views:
            raise BadInput("nothing to mesh: there are no splats or no views")
        if not self.sky:
            subject = without_sky(subject)
        if self.largest_px and subject.draw_of is not None:
            subject = without_oversized(subject, self.largest_px, self.depth)
        side, limit = self._lengths(subject)
        refuse_too_fine(side, limit, subject)
        subject = oversampled(subject, self.oversampling)
        how = ObservationSettings(self.depth, limit, self.trust, self.doubted, self.stereo, MIN_DEPTH_CONFIDENCE)
        with seen(subject, how) as sights:
            most = subject.budget_bytes // CELL_BYTES
            points = gather(sights, side, limit, self.least_weight, self.flat, most)
            if len(points.places) < MIN_TETRA_POINTS:
                raise BadInput(
                    f"no surface: of cells of {with_unit(side, subject.frame)}, {len(points.places)} have a depth with "
                    f"the weight of --mesh.least-weight {self.least_weight:g}; lower it, or train for more steps"
                )
            mesh = self.surface(sights, points, side, subject.budget_bytes)
        if not len(mesh.faces):
            raise BadInput(
                "no surface: between what is seen through and what is not, no place is confirmed by --mesh.least-views "
                f"{self.least_views}; lower it, or train for more steps"
            )
        return replace(mesh, facts=facts(side, limit, subject.frame) | {"points": len(points.places)})

    def _lengths(self, subject: MeshInput) -> tuple[float, float]:
        """Side of a cell and the largest depth, local units."""
        side, limit = (to_local(value, subject.frame) for value in (self.cell, self.depth_limit))
        if side is None or limit is None:
            depth, pixel, far = look(subject, self.depth)
            side, limit = side or self.cell_px * pixel, limit or max(2 * depth, far)
        return side, limit

    def surface(self, sights: ViewObservations, points: SurfacePoints, side: float, budget_bytes: int = 2**62) -> Mesh:
        """The surface of what views see, without facts.

        Args:
            sights: What they see.
            points: On the surface.
            side: Of a cell, local units.
            budget_bytes: Memory for the tetrahedra of a tile.
        """
        decided, found = DecidedTetrahedra(), []
        most = budget_bytes // TETRA_POINT_BYTES
        parts = tiles(points.places, most, HALO * side)
        if (largest := max(len(tile.rows) for tile in parts)) > most:
            needed, given = (f"{count * TETRA_POINT_BYTES / 1e9:.1f} GB" for count in (largest, most))
            told = f"one tile needs about {needed}, more than the {given} of --memory; a larger --mesh.cell needs less"
            emit(Warned(told))
        for tile in parts:
            found.append(self.cut(sights, points.take(tile.rows), side, tile, decided))
        faces = np.concatenate(found)
        faces = faces[np.argsort(faces.min(1), kind="stable")]  # as the points: near ones are near
        faces = faces[supported(sights, points.places, faces, side, self.least_views, self.guesses)]
        used, at = np.unique(faces, return_inverse=True)
        mesh = Mesh(points.places[used].astype(np.float32), at.reshape(-1, 3).astype(np.int32), points.colors[used])
        if not len(faces):
            return mesh
        near = side * min(min(camera.fx, camera.fy) for camera in sights.cameras)
        mesh = separated(mesh)
        if len(parts) > 1:
            mesh, _ = close_holes(mesh, MAX_CRACK_EDGES)
        return apart(adjusted(sights, mesh, side, near, self.smooth))

    def cut(
        self, sights: ViewObservations, points: SurfacePoints, side: float, tile: TetraTile, decided: DecidedTetrahedra
    ) -> np.ndarray:
        """(F, 3) rows of all points: the faces of a tile between empty and full tetrahedra, facing outwards.

        Args:
            sights: What the views see.
            points: Of the tile.
            side: Of a cell, local units.
            tile: See `tiles`.
            decided: By tiles before; what this one decides is added.
        """
        native, threads = kernels(), torch.get_num_threads()
        tets = tetrahedralised(points.places, tile.step)
        given = decided.of(tile, tets.corners)
        count = len(tets.corners)
        volumes = np.empty(count)
        native.volumes(tets.points, tets.corners, volumes, threads)
        owner, shell, starts, places, cells = places_of(points, tets, volumes, side, given == UNDECIDED)
        empty, full = np.zeros(len(places), np.float32), np.zeros(len(places), np.float32)

        boxes = boxes_of(places)

        def vote(sight: Any) -> None:
            noise = self.noise_px / min(sight.camera.fx, sight.camera.fy) + self.noise
            native.vote(places, boxes, noise, self.thickness, empty, full, *sight.native, threads)

        for_all(sights, "voting" + tile.title, vote, places)
        votes = empty + full
        enclosed = (tets.corners < len(points.places)).all(1)
        hidden = np.where(enclosed, self.hidden, 0).astype(np.float32)
        balance = (empty - full - hidden[owner]) / (votes + self.damping)
        within = np.maximum(np.diff(starts, append=shell), 1)
        volume = np.bincount(owner[:shell], balance[:shell], count) / within * volumes
        volume += np.bincount(owner[shell:], balance[shell:] * cells, count) * (side**3 * SHELL_DEPTH)
        volume[self._cameras(sights, tets)] += CAMERA_CELL_VOLUME * side**3
        evidence = np.bincount(owner[:shell], votes[:shell], count) / within
        looked = np.bincount(owner[shell:], minlength=count)
        evidence = np.maximum(evidence, np.bincount(owner[shell:], votes[shell:], count) / np.maximum(looked, 1))
        cost = np.empty((count, 4), np.int32)
        weigh = side, self.aligned, self.sure, self.certain
        native.price(
            tets.points,
            tets.corners,
            tets.neighbours,
            points.normals,
            evidence.astype(np.float32),
            *weigh,
            cost,
            threads,
        )
        most = cost.sum(1, dtype=np.int64) + 1  # from there on, no neighbour turns a tetrahedron over
        bias = np.rint(volume * (native.CUT_UNITS / (self.area * side**3)))
        bias = np.clip(bias, -most, most).astype(np.int64)
        bias[given == 1], bias[given == 0] = -most[given == 1], most[given == 0]
        sides = np.empty(count, np.uint8)
        native.minimum_cut(tets.neighbours, cost, bias, sides)
        full = sides == 1
        decided.add(tile, tets.corners, full)
        rows, corner = np.nonzero(full[:, None] & (tets.neighbours >= 0) & ~full[tets.neighbours])
        faces = np.take_along_axis(tets.corners[rows], OUTWARD[corner], 1)
        of = tile.tile_of[faces]
        return tile.rows[faces[(of.min(1) == tile.number) & (of.max(1) < LAST)]]

    def _cameras(self, sights: ViewObservations, tets: Tetrahedra) -> np.ndarray:
        """Numbers of the tetrahedra that hold a camera: they are empty."""
        centres = np.stack([camera.centre.numpy() for camera in sights.cameras]).astype(np.float64)
        found, start = np.empty(len(centres), np.int32), np.zeros(len(centres), np.int32)
        kernels().locate(tets.points, tets.corners, tets.neighbours, centres, start, found, torch.get_num_threads())
        return found[found >= 0]


def refuse_too_fine(side: float, limit: float, subject: MeshInput) -> None:
    """BadInput if cells of a side cannot be numbered as far as views see; lengths in local units."""
    centres = torch.stack([view.camera.centre for view in subject.views]).abs()
    farthest, most = float(centres.max()) + limit, (1 << (kernels().CELL_BITS - 1)) - 1
    if farthest > most * side:
        least, frame = 1.01 * farthest / most, subject.frame
        raise BadInput(
            f"mesh.cell is {with_unit(side, frame)}, too small for a scene of {with_unit(2 * farthest, frame)}; give "
            f"{with_unit(least, frame)} or more, or a lower --mesh.depth-limit"
        )


def facts(side: float, limit: float, frame: Frame) -> dict[str, Any]:
    """The lengths for mesh.json, in units of the data set and in metres where they are known."""
    values, metres = {"cell": side, "depth_limit": limit}, frame.local_metres
    found = {name: value / frame.scale for name, value in values.items()}
    return found | ({f"{name}_m": value * metres for name, value in values.items()} if metres else {})
