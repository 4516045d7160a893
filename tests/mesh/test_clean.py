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
    with pytest.raises(BadInput, match="outside the crop: is it in the frame of the input"):
        clean(mesh, 50, 50, box((50, 50, 50, 60, 60, 60)).inside)
    with pytest.raises(BadInput, match="--crop-box 1 0 0 0 1 1: give the lowest"):
        box((1, 0, 0, 0, 1, 1))
    for text in ("{", "[]", '{"orthogonal_axis": "W"}', json.dumps(volume | {"bounding_polygon": [[1, 2, 3]]})):
        path.write_text(text)
        with pytest.raises(
            BadInput, match="not JSON|expected an object|no crop volume|bounding_polygon|orthogonal_axis"
        ):
            read_crop(path)
    with pytest.raises(BadInput, match="no such file"):
        read_crop(tmp_path / "none.json")


def test_an_empty_mesh_is_said():
    nothing = Mesh(np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    with pytest.raises(BadInput, match="has no triangles"):
        clean(nothing, 50, 50)
    lost = Mesh(np.full((3, 3), np.nan, np.float32), np.array([[0, 1, 2]], np.int32))
    with pytest.raises(BadInput, match="none is whole"):
        clean(lost, 50, 50)
