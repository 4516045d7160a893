"""Cleaning leaves out what is no surface, and nothing else."""

import json

import numpy as np
import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh
from surfkit.mesh.clean import boundaries, clean, clusters
from surfkit.scene.crop import box, read_crop

trimesh = needs("trimesh")


def ball(centre=(0, 0, 0), divisions=2):
    found = trimesh.creation.icosphere(divisions)
    return np.asarray(found.vertices + centre, np.float32), np.asarray(found.faces, np.int32)


def together(*parts):
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=False)])
    colors = np.arange(3 * len(vertices)).reshape(-1, 3).astype(np.uint8)
    return Mesh(vertices, faces.astype(np.int32), colors)


def test_small_clusters_go_and_few_clusters_are_no_error():
    mesh = together(ball(), ball((5, 0, 0), 1), ball((9, 0, 0), 0))  # 320, 80 and 20 triangles
    kept, report = clean(mesh, 50, 50)
    assert len(kept.faces) == 400 and (report.clusters, report.clusters_kept, report.clustered) == (3, 2, 20)
    assert kept.vertices[:, 0].max() < 7 and len(kept.colors) == len(kept.vertices) == report.vertices
    assert len(clean(mesh, 1, 1)[0].faces) == 320
    assert len(clean(mesh, 2, 1)[0].faces) == 400
    assert len(clean(mesh, 50, 1)[0].faces) == 420
    assert len(clean(mesh, 50, 1_000)[0].faces) == 320, "the largest stays when all are small"
    labels, sizes = clusters(mesh)
    assert sizes.tolist() == [320, 80, 20] and (np.bincount(labels) == sizes).all()


def strip(start, count, height=0.0):
    """`count` squares of two triangles with sides of 1, along x from `start` on."""
    along = np.arange(count + 1)
    vertices = np.stack(
        [np.tile(along + start, 2), np.repeat([0.0, 1.0], count + 1), np.full(2 * count + 2, height)], 1
    )
    a = along[:-1]
    b = a + count + 1
    return vertices.astype(np.float32), np.concatenate([np.stack([a, a + 1, b], 1), np.stack([b, a + 1, b + 1], 1)])


@pytest.mark.parametrize("shift", [0.0, 0.37, 5000.2])
def test_pieces_with_a_small_gap_are_one_cluster(shift):
    """In cells of 3: what is nearer than 3 touches always, what is farther than 6 never."""
    parts = strip(shift, 60), strip(shift + 62.5, 2), strip(shift + 71.5, 2), strip(shift, 2, height=2.9)
    mesh = together(*parts)
    labels, sizes = clusters(mesh, gap=3.0)
    assert sorted(sizes) == [4, 128] and (labels == labels[0]).sum() == 128 and labels[125] != labels[0]
    assert sorted(clusters(mesh)[1]) == [4, 4, 4, 120]
    kept, report = clean(mesh, 50, 50, gap=3.0)
    assert len(kept.faces) == 128 and (report.clusters, report.clusters_kept, report.clustered) == (2, 1, 4)
    mesh = together(strip(0, 60), strip(60, 10), strip(72, 1))
    mesh.vertices[-1] = np.nan  # with the last piece, a triangle of which is whole
    kept, report = clean(mesh, 50, 3, box((-1, -1, -1, 59.9, 2, 1)).inside, gap=3.0)
    assert (report.not_finite, report.clusters) == (1, 1) and len(kept.faces) == 120
    both = clean(mesh, 50, 1, lambda at: (at[:, 0] < 50) | (at[:, 0] > 70), gap=3.0)[1]
    assert both.clusters == 2, "what is cropped away between them does not connect them"
    far = together(strip(0, 60), strip(1e9, 60), strip(3e9, 2))
    assert sorted(clusters(far, gap=3.0)[1]) == [4, 120, 120], "so far that cells of 3 could not be numbered"


def test_clusters_with_a_gap_are_those_of_all_pairs_of_cells(rng=np.random.default_rng(4)):
    """Against labels that scipy's image functions give for a dense grid of the same cells."""
    from scipy import ndimage

    middles = rng.uniform(0, 40, (300, 3)).astype(np.float32)
    vertices = (middles[:, None] + np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])).reshape(-1, 3)
    mesh = Mesh(vertices, np.arange(900, dtype=np.int32).reshape(-1, 3), None)
    labels, sizes = clusters(mesh, gap=2.0)
    cells = ((vertices.astype(np.float64) - vertices.min(0)) / 2.0).astype(int)
    grid = np.zeros(cells.max(0) + 1, bool)
    grid[tuple(cells.T)] = True
    wanted = ndimage.label(grid, np.ones((3, 3, 3)))[0][tuple(cells[mesh.faces[:, 0]].T)]
    assert 3 < len(sizes) < 200
    pairs = {(a, b) for a, b in zip(labels.tolist(), wanted.tolist(), strict=True)}
    assert len(pairs) == len(sizes) == len(set(wanted.tolist())), "a one-to-one map of the labels"


def test_broken_triangles_and_duplicate_vertices_go():
    vertices, faces = ball()
    doubled = np.concatenate([vertices[faces].reshape(-1, 3), [[np.nan, 0, 0]]]).astype(
        np.float32
    )  # no shared vertices
    own = np.arange(3 * len(faces)).reshape(-1, 3)
    broken = np.array([[0, 1, len(doubled) - 1], [2, 2, 5], [0, 1, 1]])
    colors = np.zeros((len(doubled), 3), np.uint8)
    kept, report = clean(Mesh(doubled, np.concatenate([own, broken]).astype(np.int32), colors), 50, 50)
    assert (report.not_finite, report.degenerate, report.clusters) == (1, 2, 1)
    assert len(kept.vertices) == len(vertices) and len(kept.faces) == len(faces)
    assert trimesh.Trimesh(kept.vertices, kept.faces, process=False).is_watertight


def test_vertices_in_one_place_become_the_first_of_them(rng=np.random.default_rng(7)):
    soup = rng.integers(-2, 3, (400, 3, 3)).astype(np.float32) * np.float32(0.1)  # few places, so many share one
    soup[soup == 0] *= rng.choice([-1, 1], (soup == 0).sum()).astype(np.float32)
    colors = rng.integers(0, 256, (1200, 3)).astype(np.uint8)
    mesh, _ = clean(Mesh(soup.reshape(-1, 3), np.arange(1200, dtype=np.int32).reshape(-1, 3), colors), 50, 1)
    first = {}
    for place, color in zip(soup.reshape(-1, 3).tolist(), colors.tolist(), strict=True):
        first.setdefault(tuple(place), color)  # 0 and -0 are equal
    assert len(mesh.vertices) <= len(first) < 200
    assert len({tuple(place) for place in mesh.vertices.tolist()}) == len(mesh.vertices)
    assert mesh.colors.tolist() == [first[tuple(place)] for place in mesh.vertices.tolist()]
    flat = np.linalg.norm(np.cross(soup[:, 1] - soup[:, 0], soup[:, 2] - soup[:, 0]), axis=1) < 1e-6
    assert np.array_equal(mesh.vertices[mesh.faces], soup[~flat])


def test_holes_are_reported():
    vertices, faces = ball()
    assert boundaries(Mesh(vertices, faces)) == (0, 0.0, 0.0)
    one, other = 0, next(i for i in range(len(faces)) if not set(faces[i]) & set(faces[0]))
    left = np.delete(faces, [one, other], axis=0)
    loops, longest, share = boundaries(Mesh(vertices, left))
    around = [np.linalg.norm(np.diff(vertices[faces[i]][[0, 1, 2, 0]], axis=0), axis=1).sum() for i in (one, other)]
    assert loops == 2 and longest == pytest.approx(max(around), rel=1e-5) and share == pytest.approx(6 / 480)


def test_crops(tmp_path):
    mesh = together(ball(), ball((5, 0, 0)))
    kept, report = clean(mesh, 50, 50, box((-2, -2, -2, 2, 2, 2)).inside)
    assert report.cropped == 320 and kept.vertices[:, 0].max() <= 1
    half = clean(mesh, 50, 50, box((-2, -2, 0, 2, 2, 2)).inside)[0]
    assert 100 < len(half.faces) < 220 and half.vertices[:, 2].min() > -0.3
    volume = {"orthogonal_axis": "Y", "axis_min": -3, "axis_max": 3.0, "class_name": "SelectionPolygonVolume"}
    corners = [[3, 0, -2], [7, 0, -2], [7, 0, 2]]  # x, anything, z
    path = tmp_path / "crop.json"
    path.write_text(json.dumps(volume | {"bounding_polygon": corners}))
    points = np.random.default_rng(0).uniform(-4, 8, (2000, 3))
    inside = read_crop(path).inside(points)
    x, y, z = points.T
    assert np.array_equal(inside, (abs(y) <= 3) & (x > 3) & (x < 7) & (z > -2) & (z < x - 5)) and inside.sum() > 20
    with pytest.raises(BadInput, match="outside the crop"):
        clean(mesh, 50, 50, box((50, 50, 50, 60, 60, 60)).inside)
    with pytest.raises(BadInput, match="--crop-box 1 0 0 0 1 1: .*lowest"):
        box((1, 0, 0, 0, 1, 1))
    for text in ("{", "[]", '{"orthogonal_axis": "W"}', json.dumps(volume | {"bounding_polygon": [[1, 2, 3]]})):
        path.write_text(text)
        with pytest.raises(
            BadInput, match="not JSON|expected an object|no crop volume|bounding_polygon|orthogonal_axis"
        ):
            read_crop(path)
    with pytest.raises(BadInput, match="no such file"):
        read_crop(tmp_path / "none.json")


def test_values_stay_with_their_vertices():
    """Through welding, crop, clusters and holes: each vertex is numbered by its place."""
    vertices, faces = ball()
    doubled = vertices[faces].reshape(-1, 3)
    number = (doubled @ np.float32([1, 10, 100])).astype(np.float32)
    own = np.arange(len(doubled), dtype=np.int32).reshape(-1, 3)
    mesh = Mesh(doubled, own[1:], values={"views": number, "error": -number})
    kept, report = clean(mesh, 50, 1, lambda at: at[:, 2] < 0.8, hole_edges=4)
    assert report.cropped and report.holes_closed == 1 and len(kept.values["views"]) == len(kept.vertices) < 162
    assert kept.values["views"] == pytest.approx(kept.vertices @ np.float32([1, 10, 100]))
    assert np.array_equal(kept.values["error"], -kept.values["views"])


def test_an_empty_mesh_is_said():
    nothing = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    with pytest.raises(BadInput, match="has no triangles"):
        clean(nothing, 50, 50)
    lost = Mesh(np.full((3, 3), np.nan, np.float32), np.array([[0, 1, 2]], np.int32))
    with pytest.raises(BadInput, match="none is whole"):
        clean(lost, 50, 50)
