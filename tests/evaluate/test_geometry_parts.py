"""Samples, voxels, distances, transforms and ICP, each against something independent."""

import json

import numpy as np
import pytest
from needs import needs
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry import thinning
from surfkit.evaluate.geometry.registration import align
from surfkit.evaluate.geometry.sampling import sample_surface
from surfkit.evaluate.geometry.scores import Distances, chamfer, curve, nearest, shares, spacing, surface_gap, tree
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.evaluate.geometry.thinning import thin, voxel_for
from surfkit.evaluate.geometry.transform import apply, fitted, read_transform, scale_of, write_transform

trimesh = needs("trimesh")


def rng(seed=0):
    return np.random.default_rng(seed)


def mesh_of(shape):
    return SurfaceFile("mesh", np.asarray(shape.vertices), np.asarray(shape.faces))


def test_samples_lie_on_the_surface_in_proportion_to_area():
    box = trimesh.creation.box((1, 2, 5))
    points = sample_surface(mesh_of(box), 3_400, rng())
    assert points.shape == (3_400, 3)
    over = np.abs(points) - [0.5, 1, 2.5]
    assert np.abs(over.max(1)).max() < 1e-12  # on a side, and not beyond its edges
    sides = [(np.isclose(points[:, axis], side)).sum() for axis, side in ((2, 2.5), (0, 0.5), (1, 1.0))]
    assert np.abs(np.array(sides) - [200, 1000, 500]).max() <= 4  # 2, 10 and 5 of 34 units of area


def test_samples_are_even_and_seeded():
    square = mesh_of(trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]))
    points, again, other = (sample_surface(square, 4_000, rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(points, again) and not np.array_equal(points, other)
    loose = np.column_stack([rng().random((4_000, 2)), np.zeros(4_000)])
    apart = [np.quantile(cKDTree(p).query(p, k=2)[0][:, 1], 0.05) for p in (points, loose)]
    assert apart[0] > 3 * apart[1]
    counts = np.histogram2d(points[:, 0], points[:, 1], 10)[0]  # 40 a cell; independent draws would scatter by 6.3
    assert counts.std() < 3.5


def test_a_mesh_of_lines_has_no_area():
    with pytest.raises(BadInput, match="no area"):
        sample_surface(SurfaceFile("flat.ply", np.zeros((3, 3)), np.array([[0, 1, 2]])), 10, rng())


def test_thinning_is_the_mean_of_each_voxel_whatever_the_blocks(monkeypatch):
    monkeypatch.setattr(thinning, "MERGE_AT", 100)
    points = rng().normal(size=(5_000, 3)) * [3, 2, 1] + [5e5, -2e6, 100]
    origin, voxel = points.min(0) - 0.1, 0.4
    cells = {}
    for point, key in zip(points, map(tuple, np.floor((points - origin) / voxel).astype(int)), strict=True):
        cells.setdefault(key, []).append(point)
    expected = np.array(sorted(np.mean(cell, axis=0).tolist() for cell in cells.values()))
    for blocks in ([points], np.array_split(points, 7)):
        found = thin(blocks, voxel, origin)
        assert np.allclose(np.array(sorted(found.tolist())), expected, atol=1e-8, rtol=0)


def test_thinning_as_open3d_does():
    o3d = needs("open3d", "the comparison with Open3D")
    points = rng().random((20_000, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(0.05)
    found = thin([points], 0.05, points.min(0) - 0.025)
    assert np.allclose(sorted(found.tolist()), sorted(np.asarray(cloud.points).tolist()), atol=1e-9)


def test_a_voxel_for_so_many_points():
    x, y = np.meshgrid(np.linspace(0, 1, 600), np.linspace(0, 1, 600))
    plane = np.stack([x.ravel(), y.ravel(), 0.3 * x.ravel()], 1)
    voxel = voxel_for(lambda: iter(np.array_split(plane, 5)), 10_000)
    assert 5_000 < len(thin([plane], voxel, plane.min(0))) < 20_000


def test_voxels_too_small_for_the_extent():
    with pytest.raises(BadInput, match="too small"):
        thin([np.array([[0.0, 0, 0], [1, 0, 0]])], 1e-7, np.zeros(3))


def brute(a, b):
    return np.sqrt(((a[:, None] - b[None]) ** 2).sum(2)).min(1)


def test_figures_agree_with_brute_force_and_open3d():
    ours, truth = rng(1).random((1_500, 3)), rng(2).random((1_200, 3)) + [0.1, 0, 0]
    distances = Distances(nearest(tree(truth), ours), nearest(tree(ours), truth))
    for there, here in ((distances.to_truth, brute(ours, truth)), (distances.to_reconstruction, brute(truth, ours))):
        assert np.abs(there - here).max() < 1e-12
    a, b = brute(ours, truth), brute(truth, ours)
    for tau in (0.01, 0.05, 0.09):
        p, r = (a < tau).mean(), (b < tau).mean()
        assert shares(distances, tau) == pytest.approx((p, r, 2 * p * r / (p + r)), abs=1e-6)
    assert chamfer(distances)["overall"] == pytest.approx((a.mean() + b.mean()) / 2, abs=1e-12)
    o3d = needs("open3d", "the comparison with Open3D")
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (ours, truth)]
    assert np.abs(np.asarray(clouds[0].compute_point_cloud_distance(clouds[1])) - distances.to_truth).max() < 1e-6
    back = np.asarray(clouds[1].compute_point_cloud_distance(clouds[0]))
    assert np.abs(back - distances.to_reconstruction).max() < 1e-6


def test_figures_by_hand():
    distances = Distances(np.array([0.0, 1, 2, 3]), np.array([0.0, 5]))
    assert shares(distances, 2.0) == (0.5, 0.5, 0.5)  # below, not at
    assert shares(distances, 0.0) == (0, 0, 0)
    assert chamfer(distances) == {"accuracy": 1.5, "completeness": 2.5, "overall": 2.0}
    assert chamfer(distances, 2.0) == {"accuracy": 1.0, "completeness": 0.0, "overall": 0.5}
    assert chamfer(Distances(np.array([9.0]), np.array([0.0])), 2.0)["overall"] is None
    taus = np.array([0, 0.5, 2, 9])
    assert curve(distances, taus).tolist() == [[*shares(distances, tau)[:2]] for tau in taus]


def test_spacings_of_a_lattice_and_of_strewn_points():
    x, y = np.meshgrid(np.arange(60), np.arange(60))
    lattice = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) * 0.5
    assert spacing(tree(lattice), lattice) == pytest.approx(0.5)
    assert surface_gap(tree(lattice), lattice) == pytest.approx(0.5, rel=0.2)
    strewn = rng().random((20_000, 3)) * [10, 10, 0]
    assert surface_gap(tree(strewn), strewn) == pytest.approx(10 / 20_000**0.5, rel=0.1)


def mean_ssim(scale, seed=0):
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_rotvec(rng(seed).normal(size=3) * 0.02).as_matrix()
    matrix[:3, 3] = rng(seed).normal(size=3) * 0.05
    return matrix


def bumpy(count, seed):
    x, y = rng(seed).random((2, count)) * 6
    return np.stack([x, y, np.sin(2 * x) * np.cos(3 * y) * 0.5 + 0.1 * x * y], 1)


@pytest.mark.parametrize("scale", [1.0, 1.03])
def test_icp_recovers_a_known_transform(scale):
    truth, wanted = bumpy(30_000, 0), mean_ssim(scale)
    source = apply(np.linalg.inv(wanted), bumpy(8_000, 1))
    there = tree(truth)
    found = align(lambda voxel, matrix: (source, there, truth), np.eye(4), 0.02, with_scale=True)
    assert found.scale == pytest.approx(scale, abs=1e-3)
    assert np.abs(apply(found.matrix, source) - apply(wanted, source)).max() < 0.01
    assert found.matched > 0.7 and found.residual < 0.03
    rigid = align(lambda voxel, matrix: (source, there, truth), np.eye(4), 0.02, with_scale=False)
    assert rigid.scale == pytest.approx(1, abs=1e-9)
    if scale == 1:
        assert np.abs(apply(rigid.matrix, source) - apply(wanted, source)).max() < 0.01
    else:
        assert rigid.matched < 0.8 * found.matched


def test_icp_of_the_same_points_is_exact():
    truth, wanted = bumpy(3_000, 0), mean_ssim(1.01, 3)
    source, there = apply(np.linalg.inv(wanted), truth), tree(truth)
    found = align(lambda voxel, matrix: (source, there, truth), np.eye(4), 0.02, with_scale=True)
    assert np.abs(found.matrix - wanted).max() < 1e-9 and found.matched == 1 and found.residual < 1e-9


def test_icp_as_open3d_does_one_round():
    o3d = needs("open3d", "the comparison with Open3D")
    registration = o3d.pipelines.registration
    source, target = (
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (bumpy(4_000, 1), bumpy(9_000, 0))
    )
    criteria = registration.ICPConvergenceCriteria(1e-6, 1e-6, 20)
    way = registration.TransformationEstimationPointToPoint(True)
    theirs = registration.registration_icp(source, target, 0.3, mean_ssim(1.02), way, criteria)
    from surfkit.evaluate.geometry.registration import IcpResult, icp

    points = np.asarray(target.points)
    start = IcpResult(mean_ssim(1.02), 0, None)
    ours = icp(np.asarray(source.points), tree(points), points, start, 0.3, True)
    assert ours.residual == pytest.approx(theirs.inlier_rmse, rel=1e-3)
    assert np.abs(ours.matrix - theirs.transformation).max() < 2e-3


def test_nothing_within_reach_is_left_where_it_is():
    there = tree(np.zeros((20, 3)) + 100)
    found = align(lambda voxel, matrix: (np.zeros((20, 3)), there, np.zeros((20, 3))), np.eye(4), 0.01, True)
    assert found.matched == 0 and found.residual is None and np.array_equal(found.matrix, np.eye(4))


def test_a_fit_does_not_mirror():
    points = rng().normal(size=(50, 3))
    matrix = fitted(points, points * [1, 1, -1], with_scale=False)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)


@pytest.mark.parametrize("name", ["a_trans.txt", "a.json"])
def test_transform_files_go_round(tmp_path, name):
    matrix = mean_ssim(2.5)
    write_transform(tmp_path / name, matrix)
    assert np.array_equal(read_transform(tmp_path / name), matrix) and scale_of(matrix) == pytest.approx(2.5)


def test_transform_files_of_others(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(np.eye(4).tolist()))
    (tmp_path / "b.json").write_text(json.dumps({"matrix": np.eye(4).ravel().tolist()}))
    assert np.array_equal(read_transform(tmp_path / "a.json"), read_transform(tmp_path / "b.json"))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "1 0 0", "3 numbers"),
        ("a.txt", "one two", "four rows of four numbers"),
        ("a.txt", "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "not mirror"),
        ("a.txt", "1 0.1 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "shears"),
        ("a.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 5 1", "end with the row"),
        ("a.json", '{"pose": []}', "no matrix in it under"),
        ("a.json", "{", "not JSON"),
    ],
)
def test_bad_transform_files(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(BadInput, match=message):
        read_transform(tmp_path / name)
    with pytest.raises(BadInput, match="cannot be read"):
        read_transform(tmp_path / "missing.txt")
