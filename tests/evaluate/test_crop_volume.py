"""Crop volumes: files, what lies inside, alpha shapes, and which points photographs really show."""

import json

import numpy as np
import pytest
import torch
from needs import needs
from scipy.spatial import Delaunay

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.comparison import usual_visible
from surfkit.evaluate.geometry.outline import outline
from surfkit.evaluate.geometry.point_visibility import visible, visible_counts
from surfkit.evaluate.geometry.scores import surface_gap, tree
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.evaluate.geometry.volume import CropSettings, heightened, outside_shares, visible_crop
from surfkit.scene.camera import Camera
from surfkit.scene.crop import Crop, read_crop, within, write_crop
from surfkit.scene.scene import Frame, View
from surfkit.testing.synthetic import SURFACES, Flight, photograph

STAR = np.array([[0, 0], [4, 1], [8, 0], [6, 3], [8, 7], [4, 5], [0, 7], [2, 3]], float)


def area(polygon):
    x, y = polygon.T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_crop_files_go_round_and_agree_with_open3d(tmp_path, axis):
    crop = Crop(STAR, -1.0, 2.0, axis)
    write_crop(tmp_path / "crop.json", crop)
    found = read_crop(tmp_path / "crop.json")
    assert np.array_equal(found.polygon, STAR) and (found.low, found.high, found.axis) == (-1, 2, axis)
    assert crop.area == pytest.approx(area(STAR))
    points = np.random.default_rng(0).uniform(-2, 9, (20_000, 3))
    inside = found.inside(points)
    assert 500 < inside.sum() < 5_000
    o3d = needs("open3d", "the comparison with Open3D")
    volume = o3d.visualization.read_selection_polygon_volume(str(tmp_path / "crop.json"))
    kept = volume.crop_point_cloud(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    assert np.array_equal(np.asarray(kept.points), points[inside])


def test_inside_a_polygon_as_its_triangles_say():
    points = np.random.default_rng(1).uniform(-1, 9, (5_000, 2))
    triangles = [(1, 3, 0), (0, 3, 7), (1, 2, 3), (3, 4, 5), (3, 5, 7), (5, 6, 7)]
    expected = np.zeros(len(points), bool)
    for corners in triangles:
        expected |= Delaunay(STAR[list(corners)]).find_simplex(points) >= 0
    assert np.array_equal(within(STAR, points), expected) and np.array_equal(within(STAR[::-1], points), expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"orthogonal_axis": "W"}, "must be X, Y or Z"),
        ({"axis_min": 5}, "not below axis_max"),
        ({"bounding_polygon": [[0, 0, 0], [1, 1, 1]]}, "3 or more points"),
        ({"bounding_polygon": "here"}, "no crop volume"),
        ({"axis_max": None}, "no crop volume"),
    ],
)
def test_bad_crop_files(tmp_path, change, message):
    write_crop(tmp_path / "crop.json", Crop(STAR, 0, 1))
    data = json.loads((tmp_path / "crop.json").read_text()) | change
    (tmp_path / "bad.json").write_text(json.dumps(data))
    with pytest.raises(BadInput, match=message):
        read_crop(tmp_path / "bad.json")
    with pytest.raises(BadInput, match="no such file"):
        read_crop(tmp_path / "missing.json")


def strewn(count, keep, seed=0):
    points = np.random.default_rng(seed).uniform(0, 10, (count, 2))
    return points[keep(points)]


def test_the_outline_of_an_l_is_an_l():
    ell = strewn(20_000, lambda p: (p < 4).any(1))  # 64 of 100 units of area
    found = outline(ell, 1.0)
    assert area(found) == pytest.approx(64, rel=0.03)
    probes = np.array([[1, 9], [9, 1], [2, 2], [7, 7], [5, 5], [9, 9.0]])
    assert within(found, probes).tolist() == [True, True, True, False, False, False]
    assert area(outline(ell, 100.0)) == pytest.approx(100 - 18, rel=0.03)  # the convex hull cuts the corner off


def test_holes_are_filled_and_islands_joined():
    ring = strewn(20_000, lambda p: np.abs(np.linalg.norm(p - 5, axis=1) - 4) < 1)
    assert area(outline(ring, 0.7)) == pytest.approx(np.pi * 25, rel=0.03)
    islands = strewn(20_000, lambda p: np.abs(p[:, 0] - 5) > 1.5)
    found = outline(islands, 0.5)
    assert area(found) == pytest.approx(100, rel=0.03) and within(found, np.array([[5.0, 5]])).all()


def test_a_stray_patch_does_not_count():
    points = np.concatenate([strewn(20_000, lambda p: p[:, 0] > -1), strewn(20_000, lambda p: p.max(1) < 0.6) + 30])
    assert area(outline(points, 0.5)) == pytest.approx(100, rel=0.03)


@pytest.mark.parametrize("count", [0, 2, 50])
def test_points_on_a_line_have_no_outline(count):
    with pytest.raises(BadInput, match="span no area"):
        outline(np.linspace(0, 1, count)[:, None] * [[1.0, 2.0]], 0.1)


def exact_visible(points, eye):
    """Which points a straight line from the eye reaches before it meets any surface of the synthetic scene."""
    rays = points - eye
    first = np.min([surface.hit(np.broadcast_to(eye, rays.shape), rays)[0] for surface in SURFACES], axis=0)
    return first > 1 - 1e-3


def synthetic_points(count):
    """Points strewn on ground, box and sphere, those inside other bodies left out."""
    draw = np.random.default_rng(0)
    ground = np.column_stack([draw.uniform(-12, 12, (count, 2)), np.zeros(count)])
    ground = ground[(np.abs(ground[:, :2] - [-4.25, 0.5]) > [2.75, 2.5]).any(1)]
    ball = draw.normal(size=(count // 8, 3))
    ball = ball / np.linalg.norm(ball, axis=1, keepdims=True) * 2.2 + [4, -2, 2.2]
    box = draw.uniform([-7, -2, 0], [-1.5, 3, 3], (count // 4, 3))
    side = draw.integers(0, 5, len(box))
    for i, (axis, at) in enumerate([(0, -7), (0, -1.5), (1, -2), (1, 3), (2, 3)]):
        box[side == i, axis] = at
    return np.concatenate([ground, ball, box])


def test_counts_are_those_of_exact_rays():
    scene = photograph(Flight(views=10, width=128, height=96, test_every=0)).scene
    points = synthetic_points(60_000)
    gap = surface_gap(tree(points), points)
    agree = []
    for view in scene.train:
        pose = scene.frame.input_pose(view.camera.world_to_camera)
        at, seen = visible(points, view.camera.sized(800), pose, gap)
        eye = -pose[:3, :3].T @ pose[:3, 3]
        exact = exact_visible(points[at], eye)
        assert 0.03 < 1 - exact.mean() < 0.4  # there is something to get wrong
        agree.append((exact == seen).mean())
        assert seen[exact].mean() > 0.96 and seen[~exact].mean() < 0.06
    assert np.mean(agree) > 0.96
    counts = visible_counts(points, scene.train, scene.frame, gap)
    assert counts.max() <= 10 and counts.min() == 0


def overhead(x, y, height, down=True):
    """A camera that looks down, or along +x."""
    turn = np.diag([1.0, -1, -1]) if down else np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ [x, y, height]
    return View(f"{x}", Camera(torch.from_numpy(pose), 200.0, 200.0, 160.0, 120.0, 320, 240), "none")


def test_a_wall_hides_what_is_behind_it():
    y, z = np.meshgrid(np.arange(-5, 5, 0.1), np.arange(0, 6, 0.1))
    wall = np.stack([np.full(y.size, 10.0), y.ravel(), z.ravel()], 1)
    behind = wall[::7] + [6, 0, 0]
    frame = Frame(np.zeros(3), 1.0)
    view = overhead(0, 0, 3, down=False)
    for front, expected in ((wall, [1, 0]), (np.array([[4.0, 0, 3]]), [1, 1])):
        points = np.concatenate([front, behind])
        counts = visible_counts(points, [view], frame, 0.1)
        assert counts[: len(front)].mean() > 0.99 * expected[0]
        shown = counts[len(front) :].mean()
        assert shown == pytest.approx(expected[1], abs=0.02)  # without the wall all of it is seen
    beside = behind + [0, 12, 0]
    assert not visible_counts(beside, [view], frame, 0.1).all()  # out of the picture


def test_more_photographs_do_not_make_the_volume_smaller():
    """Of a flight that is as wide as before and longer, all that was in the volume still is."""
    x, y = np.meshgrid(np.arange(-30, 330, 0.5), np.arange(-8, 8, 0.5))
    ground = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)

    def volume(count):
        views = [overhead(at, 0, 10) for at in np.linspace(0, 1.5 * (count - 1), count)]
        wanted = CropSettings(usual_visible(count), "z", 2.0, 0.25)
        return visible_crop(ground, views, Frame(np.zeros(3), 1.0), np.eye(4), wanted)

    few, many = volume(100)[1], volume(200)[1]
    assert many == pytest.approx(2 * few, rel=0.05)
    assert [usual_visible(count) for count in (1, 87, 100, 101, 50_000)] == [0.05, 0.05, 0.05, 5, 5]


def test_the_volume_ends_where_the_views_do():
    x, y = np.meshgrid(np.arange(-40, 40, 0.5), np.arange(-40, 40, 0.5))
    ground = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    cellar = ground[np.abs(ground).max(1) < 5] - [0, 0, 8]  # under the ground, where nothing sees it
    views = [overhead(x, 0, 10) for x in (-2, -1, 0, 1, 2)]
    crop, seen = visible_crop(
        np.concatenate([ground, cellar]), views, Frame(np.zeros(3), 1.0), np.eye(4), CropSettings(1.0, "z", 2.0, 0.25)
    )
    across, along = 2 * 10 * 160 / 200 - 4, 2 * 10 * 120 / 200  # what all five see
    assert crop.area == pytest.approx(across * along, rel=0.1)
    assert seen == pytest.approx(across * along / 0.25, rel=0.1)
    flat = np.concatenate([ground, cellar]), views, Frame(np.zeros(3), 1.0), np.eye(4)
    number, share = (visible_crop(*flat, CropSettings(least, "z", 2.0, 0.25))[1] for least in (3, 0.6))
    assert number == share > seen  # three of five views
    assert (crop.low, crop.high) == (-0.25, 0.25)  # not down to the cellar
    shift = np.eye(4)
    shift[:3, :3] *= 2
    shift[:3, 3] = [100, 0, 7]
    moved, _ = visible_crop(
        ground * 2 + [100, 0, 7], views, Frame(np.zeros(3), 1.0), shift, CropSettings(1.0, "z", 4.0, 0.5)
    )
    assert np.abs(moved.polygon.mean(0) - [100, 0]).max() < 2 and moved.area == pytest.approx(4 * crop.area, rel=0.05)
    with pytest.raises(BadInput, match="5 or more of 5 .*--transform"):
        visible_crop(ground + [500, 0, 0], views, Frame(np.zeros(3), 1.0), np.eye(4), CropSettings(1.0, "z", 2.0, 0.25))


@pytest.mark.parametrize("axis", ["x", "z"])
def test_a_volume_reaches_as_far_as_the_reconstruction(axis):
    """A square of 8 at height 1; a floor 2 below it, a roof 3 above, a sky at 500, and a deep floor beside it."""
    order = {"x": [2, 0, 1], "z": [0, 1, 2]}[axis]
    crop = Crop(np.array([[0, 0], [8, 0], [8, 8], [0, 8]], float), 0.5, 1.5, axis)

    def level(height, left=1.0, size=6.0):
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size + [left, 1.0]
        return np.column_stack([corners, np.full(4, height)])[:, order]

    parts = [level(1.0), level(-1.0), level(4.0), level(500.0), level(-9.0, left=20.0)]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = SurfaceFile("given", np.concatenate(parts), np.concatenate([faces + 4 * at for at in range(len(parts))]))
    found = heightened(crop, mesh, np.eye(4), 0.25)
    assert (found.low, found.high) == (-1.25, 4.25) and found.axis == axis
    assert heightened(crop, SurfaceFile("given", level(1.0), faces), np.eye(4), 0.25) == crop
    fifth = pytest.approx(0.2)
    assert outside_shares(mesh, np.eye(4), found) == {"above": fifth, "below": 0, "beside": fifth}
    assert outside_shares(mesh, np.eye(4), crop) == {"above": pytest.approx(0.4), "below": fifth, "beside": fifth}
    cloud = SurfaceFile("given", mesh.rows)
    assert outside_shares(cloud, np.eye(4), crop) == {"above": pytest.approx(0.4), "below": fifth, "beside": fifth}
    up = np.eye(4)
    up["xyz".index(axis), 3] = 5.0
    assert heightened(crop, mesh, up, 0.25).high == 9.25
