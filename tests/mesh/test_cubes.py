"""The table of marching cubes keeps what it promises."""

import numpy as np
from needs import needs

from surfkit.mesh.cubes import CUBE_EDGES, triangles

trimesh = needs("trimesh")


def case_triangles(case):
    row = triangles()[case]
    return row[: np.flatnonzero(row < 0)[0]].reshape(-1, 3)


def test_a_case_uses_exactly_the_edges_that_it_crosses():
    for case in range(256):
        crossed = set()
        for edge, (x, y, z, axis) in enumerate(CUBE_EDGES):
            one = x + 2 * y + 4 * z
            if (case >> one & 1) != (case >> (one + (1 << axis)) & 1):
                crossed.add(edge)
        assert set(case_triangles(case).ravel().tolist()) == crossed, case


def test_random_fields_give_closed_manifolds_turned_outward():
    """Any pattern of inside and outside, so every case beside every other: each side has two triangles, in opposite
    directions; and the enclosed volume is that of the field's inside."""
    draw = np.random.default_rng(0)
    side = 14
    field = np.ones((side,) * 3, bool)
    field[1:-1, 1:-1, 1:-1] = draw.random((side - 2,) * 3) > 0.4
    inside = ~field
    vertices, faces, known = [], [], {}
    for x, y, z in np.ndindex(side - 1, side - 1, side - 1):
        case = sum(int(inside[x + (c & 1), y + (c >> 1 & 1), z + (c >> 2)]) << c for c in range(8))
        for triangle in case_triangles(case):
            face = []
            for edge in triangle:
                dx, dy, dz, axis = CUBE_EDGES[edge]
                key = (x + dx, y + dy, z + dz, axis)
                if key not in known:
                    known[key] = len(vertices)
                    vertices.append(np.array(key[:3]) + 0.5 * np.eye(3)[axis])
                face.append(known[key])
            faces.append(face)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    sides = np.sort(mesh.edges, axis=1)
    _, counts = np.unique(sides, axis=0, return_counts=True)
    assert mesh.is_watertight and (counts == 2).all() and mesh.is_winding_consistent
    assert 0.5 * inside.sum() < mesh.volume < 1.2 * inside.sum()
