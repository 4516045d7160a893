"""Measures against shapes with known areas, picking against trimesh and formulas, boxes and paths read back."""

import json
import math

import numpy as np
import pytest
import torch
from needs import needs

from surfkit.apps.render.path import from_file, posed
from surfkit.apps.view.crop_box import edges, sizes, turned_box, upright_axis
from surfkit.apps.view.keyframes import KeyPath, write_path
from surfkit.apps.view.layers import frustum_lines
from surfkit.apps.view.measure_clicks import coordinates, decimals, in_words, measured, path_lines, shown
from surfkit.apps.view.outlines import block_outlines, outline, spread_out
from surfkit.apps.view.picking import TrianglePicker, corners_of, hit_camera, hit_points, hit_splats
from surfkit.apps.view.tools import free_name
from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh
from surfkit.partition.base import Cells, Contraction, Ground
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.model import SplatModel
from surfkit.raster.select import select
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.run_method import with_drawing
from surfkit.scene.camera import Camera
from surfkit.scene.crop import read_crop, write_crop
from surfkit.scene.scene import Frame, Scene, SparsePoints, View
from surfkit.scene.up_direction import map_axes

UP = np.array([0.0, 0.0, 1.0])
FAR = np.array([492_000.0, 5_260_000.0, 430.0])
FRAME = Frame(FAR, 0.01, 1.0, "EPSG:32632", (492_000.0, 5_260_000.0, 0.0))
LENS = Camera(torch.eye(4, dtype=torch.float64), 50.0, 60.0, 30.0, 20.0, 64, 48)


def turned(points, axis, degrees):
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis, float) / np.linalg.norm(axis))
    return points @ turn.as_matrix().T


def circle(count, radius=1.0):
    angle = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def test_a_polygon_has_its_area_however_it_lies():
    for count, tilt in ((3, 0), (7, 35), (100, 60)):
        points = turned(circle(count, 3.0), (1, 0, 0), tilt) + FAR
        area = 0.5 * count * 9 * math.sin(2 * math.pi / count)
        found = measured(points, UP, 2.0)
        assert found.area == pytest.approx(4 * area, rel=1e-9)
        assert found.plan == pytest.approx(4 * area * math.cos(math.radians(tilt)), rel=1e-9)


def test_an_l_and_a_line():
    l_shape = np.array([[0, 0, 0], [4, 0, 0], [4, 1, 0], [1, 1, 0], [1, 3, 0], [0, 3, 0]], float)
    assert measured(l_shape[::-1], UP).area == pytest.approx(6)
    found = measured(np.array([[0, 0, 0], [3, 4, 0], [3, 4, 12]], float), UP)
    assert (found.length, found.level, found.rise) == pytest.approx((17, 5, 12))
    down = measured(np.array([[0, 0, 5], [0, 1, 2]], float), UP)
    assert down.rise == pytest.approx(-3) and down.area == 0
    assert measured(np.zeros((0, 3)), UP).length == measured(np.ones((1, 3)), UP).length == 0


def test_metres_are_named_only_where_they_are_known():
    found = measured(circle(4), UP)
    assert "m²" in in_words(found, FRAME, 4)
    said = in_words(found, Frame(np.zeros(3), 1.0), 4)
    assert "m²" not in said and "square units" in said and "2.000 square units" in said
    assert "area" not in in_words(found, FRAME, 2) and "two points" in in_words(found, FRAME, 1)
    assert [shown(value) for value in (0, 1234.567, 12.3456, 123.456, 1e-4)] == [
        "0.000", "1,234.6", "12.346", "123.46", "0.0001",
    ]  # fmt: skip


def test_coordinates_are_those_of_the_data_set():
    assert coordinates(np.array([0.01, -0.02, 0.5]), FRAME, UP) == (
        "E 492001.000, N 5259998.000, height 480.000 (EPSG:32632)"
    )
    assert "not georeferenced" in coordinates(np.zeros(3), Frame(np.ones(3), 1.0), UP)
    place = Frame(np.zeros(3), 1.0, 1.0, "+proj=topocentric +ellps=WGS84 +lat_0=50 +lon_0=7 +h_0=100")
    assert coordinates(np.array([1.0, 2.0, 3.0]), place, UP).startswith("east 1.00")
    assert decimals(Frame(np.zeros(3), 1e-3)) == 2 and decimals(Frame(np.zeros(3), 1e3)) == 8
    y_up = np.array([0.0, 1.0, 0.0])
    assert np.allclose(map_axes(y_up) @ [5, 7, 9], [5, -9, 7])


def test_a_line_is_closed_only_if_it_has_three_points():
    points = [np.array(p, float) for p in ((0, 0, 0), (1, 0, 0), (1, 1, 0))]
    assert len(path_lines(points[:1], True)) == 0 and len(path_lines(points[:2], True)) == 1
    assert len(path_lines(points, False)) == 2
    assert np.array_equal(path_lines(points, True)[-1], [[1, 1, 0], [0, 0, 0]])


def soup(count=4000):
    draw = np.random.default_rng(0)
    middles = draw.uniform(-1, 1, (count, 1, 3))
    return (middles + draw.normal(0, 0.05, (count, 3, 3))).reshape(-1, 3).astype(np.float32), np.arange(
        3 * count
    ).reshape(-1, 3)


def test_rays_meet_triangles_where_trimesh_says():
    trimesh = needs("trimesh")
    ball = trimesh.creation.icosphere(5, 1.0)
    found = TrianglePicker(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces))
    assert len(found.starts) > 10, "in many cells"
    draw = np.random.default_rng(1)
    origins = draw.normal(0, 2, (60, 3))
    directions = draw.uniform(-1.2, 1.2, (60, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    hits = 0
    for origin, direction in zip(origins, directions, strict=True):
        corners = np.asarray(ball.vertices, np.float32)[ball.faces].astype(float)
        places = trimesh.triangles  # all of them, one by one
        normals, valid = places.normals(corners)
        t = np.einsum("tk,tk->t", corners[valid][:, 0] - origin, normals) / (normals @ direction)
        bary = places.points_to_barycentric(corners[valid], origin + t[:, None] * direction)
        met = t[(t > 0) & (bary >= -1e-9).all(1)]
        got = found.hit(origin, direction)
        assert (got is None) == (len(met) == 0)
        if got is not None:
            hits += 1
            assert got == pytest.approx(met.min(), abs=1e-6)
    assert 20 < hits < 60


def test_rays_meet_triangles_in_any_order_of_cells():
    vertices, faces = soup()
    found = TrianglePicker(vertices, faces)
    one = TrianglePicker.__new__(TrianglePicker)  # all triangles in one cell
    one.vertices, one.faces = vertices, faces
    one.starts, one.ends = np.array([0]), np.array([len(faces)])
    one.low, one.high = vertices.min(0)[None], vertices.max(0)[None]
    draw = np.random.default_rng(2)
    rays = [(origin, draw.uniform(-1, 1, 3) - origin) for origin in draw.normal(0, 2, (50, 3))]
    rays += [(np.array([0.3, 0.2, 5.0]), np.array([0.0, 0.0, -1.0])), (np.zeros(3), np.array([1.0, 0.0, 0.0]))]
    answers = [(found.hit(*ray), one.hit(*ray)) for ray in rays]
    assert all(a == b for a, b in answers) and sum(a is not None for a, _ in answers) > 10


def test_points_are_met_within_a_cone():
    xyz = np.array([[0.0, 0.0, 5.0], [0.05, 0, 3.0], [0, 0, -1.0]])
    origin, ahead = np.zeros(3), np.array([0.0, 0.0, 1.0])
    assert hit_points(xyz, origin, ahead, 0.001) == pytest.approx(5)
    assert hit_points(xyz, origin, ahead, 0.02) == pytest.approx(3)
    assert hit_points(xyz[2:], origin, ahead, 0.1) is None


def test_splats_are_met_at_their_median_depth():
    z = torch.tensor([2.0, 3.0, 4.0])
    count = len(z)
    params = {
        "means": torch.stack([0 * z, 0 * z, z], 1),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        "scales": torch.tensor([[0.5, 0.5, 1e-3]]).log().repeat(count, 1),
        "opacities": torch.tensor([0.3, 0.9, 0.99]).logit(),
        "sh0": torch.zeros(count, 1, 3),
        "sh_rest": torch.zeros(count, 0, 3),
    }
    draw = with_drawing(Reconstruction(splats=SplatModel(Gaussian3D(sh_degree=0), params)), select("cpu")[0]).draw
    found = hit_splats(draw, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert found == pytest.approx(3.0, abs=0.02), "the first lets 70 % of the light through"
    slanted = np.array([0.1, 0.0, 1.0]) / np.linalg.norm([0.1, 0.0, 1.0])
    assert hit_splats(draw, np.zeros(3), slanted) == pytest.approx(3 * math.sqrt(1.01), rel=0.01)
    assert hit_splats(draw, np.zeros(3), np.array([0.0, 0.0, -1.0])) is None


def cameras(count=5):
    down = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
    return [posed(LENS, np.array([2.0 * i, 0, 3]), turned(down.T, (0, 0, 1), 20 * i).T) for i in range(count)]


def test_pictures_of_cameras_have_the_corners_that_they_project():
    centres, corners = corners_of(cameras(), 0.4)
    for camera, centre, four in zip(cameras(), centres, corners, strict=True):
        assert np.allclose(centre, camera.centre.numpy())
        x, y, z = camera.project(torch.from_numpy(four)).numpy().T
        assert np.allclose(x, [0, 64, 64, 0]) and np.allclose(y, [0, 0, 48, 48]) and np.allclose(z, 0.4 * 50 / 64)
    assert frustum_lines(centres, corners).shape == (40, 2, 3)
    assert hit_camera(corners_of([], 0.4)[1], np.zeros(3), np.ones(3)) is None
    for at, camera in enumerate(cameras()):
        ahead = camera.world_to_camera[2, :3].numpy()
        eye = camera.centre.numpy() - 5 * ahead
        assert hit_camera(corners, eye, ahead) == at
        assert hit_camera(corners, eye, -ahead) is None
        beside = camera.world_to_camera[0, :3].numpy()
        assert hit_camera(corners, eye + 0.45 * beside, ahead) is None, "that is past the edge of the picture"


def test_a_crop_box_is_read_back_by_the_reader_of_crops(tmp_path):
    for axis, heading in (("z", 0.0), ("z", 30.0), ("y", -20.0), ("x", 45.0)):
        crop = turned_box(FAR + [10, 20, 3], FAR + [-5, 4, 24], heading, axis)
        write_crop(tmp_path / "crop.json", crop)
        again = read_crop(tmp_path / "crop.json")
        assert np.allclose(again.polygon, crop.polygon) and (again.low, again.high) == (crop.low, crop.high)
        draw = np.random.default_rng(3)
        points = FAR + draw.uniform(-20, 30, (9000, 3))
        along = "xyz".index(axis)
        plane = [k for k in range(3) if k != along]
        basis = turned(np.eye(3), (0, 0, 1), heading)[:2, :2].T  # sides of the box in columns
        ends = np.stack([FAR + [10, 20, 3], FAR + [-5, 4, 24]])
        flat, ends_flat = points[:, plane] @ basis, ends[:, plane] @ basis
        inside = ((flat > ends_flat.min(0)) & (flat < ends_flat.max(0))).all(1)
        inside &= (points[:, along] > ends[:, along].min()) & (points[:, along] < ends[:, along].max())
        assert np.array_equal(again.inside(points), inside) and 10 < inside.sum() < 3000
        assert np.prod(sizes(crop)) == pytest.approx(crop.area * (crop.high - crop.low), rel=1e-4)
        assert edges(crop).shape == (12, 2, 3)
        lengths = np.linalg.norm(np.diff(edges(crop), axis=1)[:, 0], axis=1)
        assert sorted(np.round(lengths, 6)) == sorted(np.round(np.repeat(sizes(crop), 4), 6))


def test_a_flat_crop_box_is_refused():
    with pytest.raises(BadInput, match="no volume"):
        turned_box(np.zeros(3), np.array([1.0, 0.0, 1.0]), 0.0, "z")
    assert upright_axis(np.array([0.1, -0.9, 0.2])) == "y"


def test_a_path_is_read_back_by_render(tmp_path):
    keys = cameras(4)
    path = KeyPath([camera.world_to_camera.numpy() for camera in keys], 2.0, 25.0, 50.0)
    assert write_path(tmp_path / "deep" / "path.json", path, FRAME) == 50
    scene = Scene("s", (View("a", LENS, tmp_path),), (), SparsePoints(torch.zeros(0, 3), torch.zeros(0, 3)), FRAME)
    flight = from_file(tmp_path / "deep" / "path.json", scene.frame, LENS, 7)
    assert len(flight.cameras) == 50 and flight.fps == 25
    for at, key in ((0, keys[0]), (-1, keys[-1])):
        assert np.allclose(flight.cameras[at].world_to_camera, key.world_to_camera, atol=1e-6)
        fov = 2 * math.atan(LENS.height / 2 / flight.cameras[at].fy)
        assert math.degrees(fov) == pytest.approx(50)
    content = json.loads((tmp_path / "deep" / "path.json").read_text())
    first = np.array(content["camera_path"][0]["camera_to_world"]).reshape(4, 4)
    assert np.allclose(first[:3, 3], FRAME.to_input(keys[0].centre.numpy())), "survey coordinates, whole"


def test_a_path_needs_two_views(tmp_path):
    with pytest.raises(BadInput, match="two key views"):
        write_path(tmp_path / "path.json", KeyPath([np.eye(4)]), FRAME)
    assert not list(tmp_path.iterdir())
    with pytest.raises(BadInput, match="too many"):
        KeyPath([np.eye(4)] * 2, 1e9).cameras()


def test_files_are_never_replaced(tmp_path):
    names = []
    for _ in range(3):
        names.append(free_name(tmp_path, "crop"))
        names[-1].write_text("{}")
    assert [path.name for path in names] == ["crop.json", "crop-2.json", "crop-3.json"]


def test_outlines_lie_where_the_owner_changes():
    ground = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    contraction = Contraction((-1.0, -2.0), (3.0, 4.0))
    places = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * 40 - 20
    assert np.allclose(spread_out(contraction, contraction.contracted(places).numpy()), places, atol=1e-4)
    boxes = ((None, None, 0.5, None), (0.5, None, None, None))
    cells = Cells(ground, boxes, (0, 1), contraction)
    low, high = np.array([-20.0, -20.0]), np.array([20.0, 20.0])
    for box, side in zip(boxes, (-1, 1), strict=True):
        ring = outline(box, contraction, low, high)
        assert (ring >= low).all() and (ring <= high).all()
        middle = ring.mean(0)
        inner = ring + 1e-3 * (middle - ring)
        owner = cells.owner(torch.from_numpy(np.column_stack([inner, np.zeros(len(inner))])))
        assert (owner == (0 if side < 0 else 1)).all()
    points = np.random.default_rng(0).uniform(-10, 10, (2000, 3))
    segments, owner, names = block_outlines(cells, points, -UP)
    assert len(segments) == len(owner) and set(owner) == {0, 1} and len(names) == 2
    assert np.allclose(names[:, 2], points[:, 2].min(), atol=0.2), "names stand on top, and here up is down"


def test_an_empty_mesh_is_no_trouble():
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
    found = TrianglePicker(mesh.vertices, mesh.faces)
    assert found.hit(np.zeros(3), np.ones(3)) == pytest.approx(1 / 3)
    assert found.hit(np.zeros(3), -np.ones(3)) is None
