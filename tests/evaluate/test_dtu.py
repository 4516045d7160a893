"""The chamfer distance of DTU, against distances known from geometry and a plain greedy choice of points."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.dtu import (
    Observability,
    cut,
    dtu_distances,
    in_silhouettes,
    read_observability,
    read_plane,
    read_scale,
    sampled,
    thinned,
)
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.testing.synthetic import Flight, photograph

EVERYWHERE = Observability(np.ones((21, 21, 21), bool), np.full(3, -100.0), 10.0)
NO_PLANE = np.array([0.0, 0.0, 0.0, 1.0])


def square(size, height):
    """Points 1 mm apart on a square at a height."""
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    return np.stack([x.ravel(), y.ravel(), np.full(size * size, height)], 1).astype(np.float64)


def test_planes_apart_are_their_distance_apart():
    found, _ = dtu_distances(square(20, 3.0), square(20, 0.0), EVERYWHERE, NO_PLANE)
    assert found == pytest.approx({"accuracy": 3.0, "completeness": 3.0, "overall": 3.0})


def test_what_is_farther_than_20_mm_does_not_count():
    both = np.concatenate([square(20, 1.0), square(20, 50.0)])
    found, counted = dtu_distances(both, square(20, 0.0), EVERYWHERE, NO_PLANE)
    assert found["accuracy"] == pytest.approx(1.0) and len(counted.to_truth) == 800


def test_only_what_the_scanner_saw_and_what_is_above_the_table_counts():
    seen = EVERYWHERE.seen.copy()
    seen[:, :, 11:] = False  # cells from 5 mm up on
    mask = Observability(seen, EVERYWHERE.low, EVERYWHERE.cell)
    points = np.concatenate([square(20, 1.0), square(20, 8.0)])
    scan = np.concatenate([square(20, 0.0), square(20, -4.0)])
    found, counted = dtu_distances(points, scan, mask, np.array([0.0, 0.0, 1.0, 2.0]))  # the table is at -2 mm
    assert found == pytest.approx({"accuracy": 1.0, "completeness": 1.0, "overall": 1.0})
    assert (len(counted.to_truth), len(counted.to_reconstruction)) == (400, 400)
    with pytest.raises(BadInput, match="not in one frame"):
        dtu_distances(points + 1000, scan, mask, NO_PLANE)


def test_observability_rounds_to_the_nearest_cell_and_ends():
    seen = np.zeros((3, 2, 2), bool)
    seen[2, 1, 0] = True
    mask = Observability(seen, np.array([1.0, 2.0, 3.0]), 2.0)
    points = np.array([[5.0, 4.0, 3.0], [4.1, 3.1, 3.9], [5.9, 4.9, 2.1], [3.9, 4.0, 3.0], [7.1, 4.0, 3.0]])
    assert mask.inside(points).tolist() == [True, True, True, False, False]


def test_thinned_points_are_those_of_a_plain_greedy_choice():
    points = np.random.default_rng(3).random((400, 3))
    kept: list[np.ndarray] = []
    for point in points[np.random.default_rng(5).permutation(400)]:
        if all(np.linalg.norm(point - other) > 0.15 for other in kept):
            kept.append(point)
    assert np.array_equal(thinned(points, 0.15, np.random.default_rng(5)), np.array(kept))


def test_points_on_a_mesh_are_spaced_and_leave_no_gap():
    corners = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]])
    mesh = SurfaceFile(Path("m.ply"), corners, np.array([[0, 1, 2], [0, 2, 3]]))
    points = sampled(mesh, np.random.default_rng(0), 0.5)
    apart = np.linalg.norm(points[:, None] - points, axis=2) + np.eye(len(points)) * 9
    assert apart.min() > 0.5 and apart.min(1).max() < 1.0
    places = np.random.default_rng(1).random((2000, 3)) * [10, 10, 0]
    assert np.linalg.norm(places[:, None] - points, axis=2).min(1).max() < 1.0


def test_silhouettes_cut_what_a_view_shows_beside_the_object():
    truth = photograph(Flight(views=6, width=64, height=48, points=40, test_every=0))
    scene = truth.scene
    middle = scene.frame.to_input(np.zeros((1, 3)))
    aim = np.array([[0.0, 0.0, 0.5]])
    masks = []
    for view in scene.train:
        mask = np.zeros((480, 640), bool)  # ten times as large as the views
        rays = aim @ scene.frame.input_pose(view.camera.world_to_camera)[:3, :3].T
        rays = rays + scene.frame.input_pose(view.camera.world_to_camera)[:3, 3]
        x = int(10 * (view.camera.fx * rays[0, 0] / rays[0, 2] + view.camera.cx))
        y = int(10 * (view.camera.fy * rays[0, 1] / rays[0, 2] + view.camera.cy))
        mask[y - 5 : y + 5, x - 5 : x + 5] = True
        masks.append(mask)
    near = aim + [0.02, 0.0, 0.0]
    points = np.concatenate([aim, near, aim + [4.0, 0.0, 0.0], middle + [0.0, 0.0, 500.0]])
    kept = in_silhouettes(points, scene.train, scene.frame, masks)
    assert kept.tolist() == [True, True, False, True]  # nobody shows the last one
    mesh = SurfaceFile(Path("m.ply"), points, np.array([[0, 1, 3], [0, 1, 2]]))
    assert cut(mesh, kept).triangles.tolist() == [[0, 1, 3]]
    with pytest.raises(BadInput, match="no face lies within the silhouettes"):
        cut(mesh, np.zeros(4, bool))


def test_files_of_the_benchmark(tmp_path):
    seen = np.zeros((2, 3, 4), np.uint8)
    seen[1, 2, 3] = 1
    savemat(tmp_path / "mask.mat", {"ObsMask": seen, "BB": np.array([[0, 1, 2], [9, 9, 9]]), "Res": 0.5})
    mask = read_observability(tmp_path / "mask.mat")
    assert mask.seen.sum() == 1 and mask.low.tolist() == [0, 1, 2] and mask.cell == 0.5
    savemat(tmp_path / "plane.mat", {"P": np.array([[1.0], [2], [3], [4]])})
    assert read_plane(tmp_path / "plane.mat").tolist() == [1, 2, 3, 4]
    np.savez(tmp_path / "cameras.npz", scale_mat_0=np.diag([2.0, 2, 2, 1]))
    assert read_scale(tmp_path / "cameras.npz")[0, 0] == 2
    whole = (tmp_path / "cameras.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[:100])  # neither OSError nor ValueError
    with pytest.raises(BadInput, match="no scale_mat_0 can be read"):
        read_scale(tmp_path / "cut.npz")
    with pytest.raises(BadInput, match="no ObsMask in it"):
        read_observability(tmp_path / "plane.mat")
    (tmp_path / "text.mat").write_text("no matrix at all")
    with pytest.raises(BadInput, match="cannot be read as a MATLAB file"):
        read_plane(tmp_path / "text.mat")
    with pytest.raises(BadInput, match="no scale_mat_0"):
        read_scale(tmp_path / "text.mat")
