"""Small holes are filled, rims stay open."""

from dataclasses import replace

import numpy as np
import pytest
from needs import needs

from surfkit.mesh import holes
from surfkit.mesh.base import Mesh
from surfkit.mesh.clean import clean
from surfkit.mesh.holes import SIDE_AREA_WEIGHT, close_holes, edges, fill

trimesh = needs("trimesh")


def ball(without=()):
    """A sphere of radius 1 without the triangles around some of its vertices."""
    solid = trimesh.creation.icosphere(3)
    keep = ~np.isin(solid.faces, without).any(1)
    return Mesh(solid.vertices.astype(np.float32), solid.faces[keep].astype(np.int32))


def sheet(side, hole=()):
    """A square of `side` cells, without some of its cells."""
    x, y = np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij")
    at = np.arange((side + 1) ** 2).reshape(side + 1, -1)
    cells = [(i, j) for i in range(side) for j in range(side) if (i, j) not in hole]
    faces = [t for i, j in cells for t in ([at[i, j], at[i + 1, j], at[i + 1, j + 1]], [at[i, j], at[i + 1, j + 1], at[i, j + 1]])]  # fmt: skip  # noqa: E501
    return Mesh(np.stack([x, y, 0 * x], 2).reshape(-1, 3).astype(np.float32), np.array(faces, np.int32))


def test_edges_are_those_that_triangles_pass_and_free_where_none_passes_them_back():
    """Also edges of three triangles, and of two that pass them the same way; by sets of pairs."""
    faces = np.random.default_rng(0).permuted(np.tile(np.arange(9, dtype=np.int32), (40, 1)), axis=1)[:, :3]
    passed = [(int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True)]
    known, free = edges(Mesh(np.zeros((9, 3), np.float32), faces))
    assert known.tolist() == sorted({min(pair) << 32 | max(pair) for pair in passed})
    wanted = sorted(pair for pair in passed if pair[::-1] not in passed)
    assert sorted(map(tuple, free.tolist())) == wanted and len(set(wanted)) < len(wanted)


def area(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area


def test_a_ball_with_holes_becomes_closed_and_faces_outwards():
    whole, holed = ball(), ball(without=(100, 300, 500))
    closed, count = close_holes(holed, 6)
    solid = trimesh.Trimesh(closed.vertices, closed.faces, process=False)
    assert count == 3 and solid.is_watertight and solid.is_winding_consistent
    full = trimesh.Trimesh(whole.vertices, whole.faces, process=False).volume
    assert 0.99 * full < solid.volume < full
    assert close_holes(holed, 4) == (holed, 0), "longer rings stay open"


def test_the_rim_of_open_ground_stays_and_the_hole_in_it_is_filled():
    holed = sheet(8, hole=[(3, 3), (3, 4), (4, 3)])
    closed, count = close_holes(holed, 1000)
    assert count == 1 and np.isclose(area(closed), 64) and np.isclose(area(holed), 61)
    up = np.cross(*(closed.vertices[closed.faces[:, i]] - closed.vertices[closed.faces[:, 0]] for i in (1, 2)))
    assert (up[:, 2] > 0).all(), "no triangle is turned over, and none without area"
    assert close_holes(sheet(2), 1000)[1] == 0, "a loose patch is no hole"


def test_rings_that_touch_are_left():
    holed = sheet(8, hole=[(3, 3), (4, 4)])  # they share a vertex
    assert close_holes(holed, 100) == (holed, 0)


def test_a_bent_ring_is_spanned_by_the_least_area():
    """A square frame folded along its diagonal: the two triangles beside the fold, not those across it."""
    ring = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 2], [0, 1, 0]], float)
    flat = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [0, 1, 0]], float)
    faces = fill(np.stack([flat, ring]))[1]
    areas = {}
    for split in ([[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]):
        a, b, c = ring[np.array(split)].transpose(1, 0, 2)
        areas[tuple(sorted(tuple(sorted(f)) for f in split))] = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert tuple(sorted(tuple(sorted(f)) for f in faces)) == min(areas, key=areas.get)


@pytest.mark.parametrize("count", [3, 5, 8])
def test_rings_are_spanned_with_the_least_cost_of_all_ways(count):
    """Against every way to cut a polygon into triangles, tried one by one."""

    def ways(low, high):
        if high - low < 2:
            return [[]]
        return [
            [*one, *other, (low, middle, high)]
            for middle in range(low + 1, high)
            for one in ways(low, middle)
            for other in ways(middle, high)
        ]

    def cost(ring, faces):
        a, b, c = ring[np.array(faces)].transpose(1, 0, 2)
        sides = ((b - a) ** 2 + (c - b) ** 2 + (c - a) ** 2).sum()
        return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() + SIDE_AREA_WEIGHT * sides

    rings = np.random.default_rng(count).normal(size=(20, count, 3))
    for ring, faces in zip(rings, fill(rings), strict=True):
        best = min(ways(0, count - 1), key=lambda way: cost(ring, way))
        assert sorted(map(tuple, faces.tolist())) == sorted(best)


def test_many_rings_are_filled_in_parts(monkeypatch):
    holed = ball(without=(100, 300, 500))
    whole = close_holes(holed, 6)
    monkeypatch.setattr(holes, "BATCH_CORNER_PAIRS", 1)
    closed, count = close_holes(holed, 6)
    assert count == whole[1] == 3 and np.array_equal(closed.faces, whole[0].faces)


def test_cleaning_says_how_many():
    holed = replace(ball(without=(100, 300)), colors=None)
    mesh, report = clean(holed, 50, 50, hole_edges=10)
    assert report.holes_closed == 2 and report.boundaries == 0 and len(mesh.faces) == report.triangles
    assert clean(holed, 50, 50)[1].holes_closed == 0 and clean(holed, 50, 50)[1].boundaries == 2


def test_no_edge_gets_a_third_triangle():
    """A square hole both of whose diagonals are edges of the mesh already."""
    ring = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    outer = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], np.float32)
    around = [t for i in range(4) for j in [(i + 1) % 4] for t in ([4 + i, 4 + j, j], [4 + i, j, i])]
    handles = [[0, 8, 2], [2, 8, 0], [1, 9, 3], [3, 9, 1]]  # both diagonals are edges of two triangles already
    vertices = np.concatenate([ring, outer, np.array([[0.5, 0.5, 5], [0.5, 0.5, -5]], np.float32)])
    holed, blocked = (Mesh(vertices, np.array(faces, np.int32)) for faces in (around, around + handles))
    assert close_holes(holed, 4)[1] == 1 and close_holes(blocked, 4) == (blocked, 0)
