"""Simplifying by fast-simplification lays triangles on one another; afterwards, none are."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from needs import needs

from surfkit.mesh.base import Mesh
from surfkit.mesh.folds import unfolded
from surfkit.mesh.simplify import simplify_to

SQUARE = [[0, 1, 2], [0, 2, 3]]
PLACES = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 0.5], [1, 1, -3]], np.float32)


def counted(mesh):
    """Triangles of each three places, and of each two."""
    corners = [sorted(map(tuple, mesh.vertices[face].tolist())) for face in mesh.faces]
    return Counter(map(tuple, corners)), Counter(
        side for a, b, c in corners for side in [*pairwise((a, b, c)), (a, c)] if side[0] != side[1]
    )


def shreds(noise, seed=0, side=50):
    """Rough ground of height sin x sin y, of which three triangles of ten are missing."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(*2 * [np.arange(side + 1) * 0.1], indexing="ij")
    z = 0.5 * np.sin(x) * np.sin(y) + noise * rng.normal(size=x.shape)
    at = np.arange((side + 1) ** 2).reshape(side + 1, -1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = faces[rng.random(len(faces)) > 0.3].astype(np.int32)
    vertices = np.stack([x, y, z], 2).reshape(-1, 3).astype(np.float32)
    return Mesh(vertices, faces, ((vertices + 1) * 30).astype(np.uint8))


@pytest.mark.parametrize("noise", [0.1, 0.3])
def test_nothing_lies_on_another_after_simplifying(noise):
    needs("fast_simplification")
    large = shreds(noise)
    triangles, sides = counted(large)
    assert max(triangles.values()) == 1 and max(sides.values()) == 2
    small = simplify_to(large, len(large.faces) // 8)
    triangles, sides = counted(small)
    assert max(triangles.values()) == 1 and max(sides.values()) == 2
    assert len(large.faces) // 10 < len(small.faces) <= len(large.faces) // 8
    assert len(small.colors) == len(small.vertices) == len(np.unique(small.faces))


def test_a_mesh_without_folds_stays_as_it_is():
    mesh = Mesh(PLACES[:4], np.array(SQUARE, np.int32))
    assert unfolded(mesh, mesh) is mesh


@pytest.mark.parametrize("first", [[1, 2, 4], [2, 1, 4]])
def test_of_a_fold_at_the_rim_the_side_that_fits_stays(first):
    """The triangle beyond the edge from 1 to 2 passes it the other way; vertices are taken for one by their places."""
    copies = np.concatenate([PLACES[:5], PLACES[[1, 2, 4]]])
    again = [{1: 5, 2: 6, 4: 7}[corner] for corner in first[::-1]]
    found = unfolded(Mesh(copies, np.array([*SQUARE, first, again], np.int32)), Mesh(PLACES[:4], np.array(SQUARE)))
    kept = copies[[first, again][first == [1, 2, 4]]]  # from 2 to 1
    assert np.array_equal(found.vertices[found.faces[:2]], PLACES[SQUARE])
    assert len(found.faces) == 3 and np.array_equal(found.vertices[found.faces[2]], kept)


def test_a_fold_that_stands_on_a_surface_goes():
    """Both of its triangles, though they are smaller and larger than those that they stand on."""
    for tip in (4, 5):
        folded = Mesh(PLACES, np.array([*SQUARE, [0, 2, tip], [2, 0, tip]], np.int32))
        found = unfolded(folded, Mesh(PLACES, np.array(SQUARE, np.int32)))
        assert np.array_equal(found.vertices[found.faces], PLACES[SQUARE])


def test_walls_that_meet_in_the_mesh_that_is_given_stay():
    walls = Mesh(PLACES, np.array([*SQUARE, [0, 2, 4]], np.int32))
    assert unfolded(walls, walls) is walls
    assert len(unfolded(walls, Mesh(PLACES, np.array(SQUARE, np.int32))).faces) == 2


def test_what_has_become_a_line_goes():
    line = Mesh(np.concatenate([PLACES, PLACES[:1]]), np.array([*SQUARE, [0, 6, 3]], np.int32))
    found = unfolded(line, line)
    assert np.array_equal(found.vertices[found.faces], PLACES[SQUARE]) and len(found.vertices) == 4
