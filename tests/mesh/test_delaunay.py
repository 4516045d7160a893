"""Tetrahedra against Qhull, and against what makes them Delaunay's, in whole numbers."""

import numpy as np
import pytest
from needs import needs_native
from scipy.spatial import Delaunay

from surfkit.mesh.delaunay import tetrahedralised

pytestmark = needs_native


def names(corners):
    return set(map(tuple, np.sort(corners, axis=1).tolist()))


def lattice(side):
    return np.stack(np.meshgrid(*[np.arange(float(side))] * 3), -1).reshape(-1, 3)


def require_delaunay(tets):
    """Positive volumes that fill the hull, faces that two share, and no point within the ball of a neighbour."""
    points, corners, neighbours = tets.points, tets.corners, tets.neighbours
    a, b, c, d = points[corners].transpose(1, 0, 2)
    volumes = np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a)
    whole = abs(np.linalg.det(points[-3:] - points[-4]))
    assert volumes.min() > 0 and volumes.sum() == pytest.approx(whole, rel=1e-9)
    for i in range(4):
        rows = np.flatnonzero(neighbours[:, i] >= 0)
        beyond = neighbours[rows, i]
        others = [k for k in range(4) if k != i]
        for row, other in zip(rows, beyond, strict=True):
            assert len(set(corners[row, others]) & set(corners[other])) == 3
            assert (neighbours[other] == row).sum() == 1
    outside = neighbours < 0
    assert outside.sum() == 4, "the faces of the tetrahedron around all"


def test_the_same_as_qhull():
    places = np.random.default_rng(0).integers(0, 1 << 18, (3_000, 3)).astype(float)
    places[:2] = [0] * 3, [1 << 18] * 3
    tets = tetrahedralised(places)
    assert names(tets.corners) == names(Delaunay(tets.points).simplices)
    require_delaunay(tets)


def test_flat_as_a_survey():
    places = np.random.default_rng(1).normal(size=(4_000, 3)) * [1000, 1000, 1]
    tets = tetrahedralised(places)
    found, wanted = names(tets.corners), names(Delaunay(tets.points).simplices)
    assert len(found & wanted) > 0.995 * len(wanted), "but for what is rounded"


def test_points_on_common_spheres_and_planes():
    tets = tetrahedralised(lattice(7))
    require_delaunay(tets)
    assert set(tets.corners.ravel()) == set(range(7**3 + 4))


def test_points_in_one_place_are_one():
    places = lattice(3)
    tets = tetrahedralised(np.concatenate([places, places[:5]]))
    require_delaunay(tets)
    used = set(tets.corners.ravel())
    assert len(used) == 27 + 4 and all((at in used) != (at + 27 in used) for at in range(5))


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4])
def test_few_points(count):
    tets = tetrahedralised(np.random.default_rng(count).random((count, 3)))
    require_delaunay(tets)
    assert set(tets.corners.ravel()) == set(range(count + 4))
