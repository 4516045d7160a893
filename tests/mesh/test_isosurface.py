"""The surface of a function against shapes that are known exactly."""

import numpy as np
import pytest

from surfkit import BadInput
from surfkit.mesh import isosurface as module
from surfkit.mesh.base import Mesh
from surfkit.mesh.clean import boundaries
from surfkit.mesh.isosurface import isosurface

LOW, HIGH = np.array([-1.0, -1.2, -0.9]), np.array([1.1, 1.0, 1.3])


def sphere(points):
    return np.linalg.norm(points - [0.05, -0.1, 0.2], axis=1) - 0.7


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    return (np.cross(a, b) * c).sum() / 6


@pytest.mark.parametrize("tile", [7, 48])
@pytest.mark.parametrize("steepest", [None, 1.0])
def test_a_sphere_is_closed_and_of_the_right_size_whatever_the_tiles(tile, steepest, monkeypatch):
    monkeypatch.setattr(module, "TILE_CELLS", tile)
    vertices, faces = isosurface(sphere, LOW, HIGH, 0.05, steepest)
    assert vertices.dtype == np.float32 and faces.dtype == np.int32
    assert np.abs(sphere(vertices)).max() < 0.05**2, "of the second order in the side of a cell"
    assert volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.01), "and faces look outwards"
    assert boundaries(Mesh(vertices, faces))[0] == 0, "tiles meet without a gap"


def test_a_plane_is_met_exactly_and_is_open_at_the_box():
    normal = np.array([0.2, -0.3, 0.9])
    vertices, faces = isosurface(lambda p: p @ normal - 0.1, LOW, HIGH, 0.11)
    assert np.abs(vertices @ normal - 0.1).max() < 1e-6
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a) @ normal > 0).all() and boundaries(Mesh(vertices, faces))[0] == 1


def test_tiles_without_a_surface_are_not_evaluated():
    asked = [0, 0]

    def counting(which):
        def function(points):
            asked[which] += len(points)
            return points[:, 2] - 0.01

        return function

    low, high = np.full(3, -1.0), np.full(3, 1.0)
    whole = isosurface(counting(0), low, high, 0.01)
    fewer = isosurface(counting(1), low, high, 0.01, steepest=1.0)
    assert all(np.array_equal(a, b) for a, b in zip(whole, fewer, strict=True)) and asked[1] < 0.5 * asked[0]


def test_nothing_where_the_sign_does_not_change():
    vertices, faces = isosurface(lambda p: np.ones(len(p)), LOW, HIGH, 0.2)
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)


@pytest.mark.parametrize(
    ("function", "voxel", "text"),
    [
        (lambda p: np.full(len(p), np.nan), 0.2, "NaN or Inf"),
        (sphere, 0.0, "needs a size"),
        (sphere, 1e-9, "larger voxels"),
    ],
)
def test_what_cannot_be_meshed_is_refused(function, voxel, text):
    with pytest.raises(BadInput, match=text):
        isosurface(function, LOW, HIGH, voxel)


def test_a_surface_between_the_points_of_the_first_look_is_found():
    voxel = 2 / module.TILE_CELLS
    middle = -1 + voxel * (module.COARSE_STEP_CELLS * np.array([2, 1, 3]) + 0.5 * module.COARSE_STEP_CELLS)

    def small(points):
        return np.linalg.norm(points - middle, axis=1) - 1.5 * voxel

    vertices, faces = isosurface(small, np.full(3, -1.0), np.full(3, 1.0), voxel, steepest=1.0)
    assert len(faces) and np.abs(small(vertices)).max() < 0.2 * voxel
