"""How rough a mesh is where it is a plane at large.

Roughness at a place is the standard deviation of the distances of the surface around it, within a radius, to the plane
that fits it best: that of Lague, Brodu and Leroux 2013, "Accurate 3D comparison of complex topography with terrestrial
laser scanner", ISPRS Journal 82, for a ball instead of a cylinder. Of a plane with noise of standard deviation s, which
changes over much less than the radius, it is s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from surfkit.evaluate.geometry.sampling import sample_surface
from surfkit.evaluate.geometry.scores import tree
from surfkit.evaluate.geometry.surface_file import part_within
from surfkit.evaluate.mesh.boxes import MeshCube, boxes, by_area
from surfkit.evaluate.mesh.whole import WholeMesh

BALL_RADIUS_M = 1.0
"""Of the balls, where the length of a unit is known: of planes of buildings there is much, of details little."""
BALL_RADIUS_SHARE = 1 / 200
"""Radius where it is not, as a share of the square root of the area of the mesh."""
MAX_CUBES, CUBE_SIDE_RADII = 128, 6.0
"""Cubes that are measured, and the side of one in radii."""
POINTS_PER_BALL = 64
"""Points in a ball that one plane goes through the middle of."""
PLACES_PER_CUBE, MAX_CUBE_POINTS = 64, 200_000
"""In a cube: places at which roughness is measured, each time that it was chosen, and points of the surface."""
MIN_BALL_POINTS = 10
"""Points in a ball, without which nothing is measured."""
MAX_FLAT_ROUGHNESS = 0.1
"""Roughness, in radii, up to which a place counts as one of a plane: noise of a tenth of a metre in a ball of a metre
does; an edge of a roof, with 0.3 and more, does not."""


@dataclass(frozen=True)
class Roughness:
    """What was measured.

    Attributes:
        radius: Of the balls, units of the mesh.
        places: (n, 3) float64 on the mesh, evenly over its area in the cubes, coordinates without the file's offset.
        values: (n,) roughness there, units of the mesh.
    """

    radius: float
    places: np.ndarray
    values: np.ndarray

    @property
    def on_planes(self) -> float | None:
        """Median over the places on planes, of which some reach a little over an edge; None without any."""
        return median_of(self.values[self.is_plane])

    @property
    def is_plane(self) -> np.ndarray:
        """(n,) bool, which places lie on planes of the mesh."""
        return self.values <= MAX_FLAT_ROUGHNESS * self.radius


def median_of(values: np.ndarray) -> float | None:
    """Of some values; None without any."""
    return float(np.median(values)) if len(values) else None


def radius_for(mesh: WholeMesh, metres: float | None) -> float:
    """Radius in which roughness is measured, units of the mesh.

    One metre, or where the unit is not known a share of the size of the mesh, rounded to 1, 2 or 5 times a power of
    ten, so that meshes of the same scene have the same.
    """
    if metres is not None:
        return BALL_RADIUS_M / metres
    wanted = BALL_RADIUS_SHARE * math.sqrt(mesh.area)
    power = 10.0 ** math.floor(math.log10(wanted))
    return min((step * power for step in (1, 2, 5, 10)), key=lambda radius: abs(math.log(radius / wanted)))


def roughness(mesh: WholeMesh, radius: float) -> Roughness:
    """Roughness at places in some cubes of a mesh.

    The surface is sampled evenly by area, so that large triangles count as much as many small ones.
    """
    found = [
        _in_box(mesh, box, radius, np.random.default_rng([at]))
        for at, box in enumerate(boxes(mesh, CUBE_SIDE_RADII * radius, by_area(mesh, MAX_CUBES), radius))
    ]
    places, values = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Roughness(radius, places, values)


def _in_box(mesh: WholeMesh, box: MeshCube, radius: float, draw: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) places in a cube, and (n,) roughness there."""
    low, high = box.low - radius, box.high + radius
    part = part_within(mesh.part(box.faces), low, high)
    corners = part.rows.reshape(-1, 3, 3)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    if not area > 0:
        return np.empty((0, 3)), np.empty(0)
    count = min(math.ceil(area * POINTS_PER_BALL / (math.pi * radius**2)), MAX_CUBE_POINTS)
    points = sample_surface(part, count, draw)
    inner = points[box.has(points)]
    places = inner[:: max(1, len(inner) // (PLACES_PER_CUBE * box.chosen))]
    values = residuals(points, places, radius)
    known = np.isfinite(values)
    return places[known], values[known]


def residuals(points: np.ndarray, places: np.ndarray, radius: float) -> np.ndarray:
    """(n,) standard deviation of points around (n, 3) places about their plane; NaN of too few points.

    The plane takes three degrees of freedom. The sum of squares is the least eigenvalue of the scatter matrix.
    """
    if not len(places) or not len(points):
        return np.full(len(places), np.nan)
    rows = tree(points).query_ball_point(places, radius, return_sorted=False)
    counts = np.array([len(row) for row in rows])
    enough = np.flatnonzero(counts >= MIN_BALL_POINTS)
    found = np.full(len(places), np.nan)
    if not len(enough):
        return found
    counts = counts[enough]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    near = points[np.concatenate([rows[at] for at in enough])]
    near = near - np.repeat(np.add.reduceat(near, starts) / counts[:, None], counts, axis=0)
    scatter = np.add.reduceat(near[:, :, None] * near[:, None], starts)
    found[enough] = np.sqrt(np.linalg.eigvalsh(scatter)[:, 0].clip(0) / (counts - 3))
    return found
