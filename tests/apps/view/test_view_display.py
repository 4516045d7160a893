"""What is sent to a browser, within its budget, and the pictures of cameras."""

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image
from scipy.spatial.transform import Rotation

from surfkit.apps.view.browser_camera import whole_view
from surfkit.apps.view.browser_geometry import (
    by_block,
    by_height,
    by_normal,
    drawn,
    fewer_faces,
    height_bounds,
    normals_of,
    some,
)
from surfkit.apps.view.error_pictures import WORST_ERROR, error_picture, picture, thumbnail
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.apps.view.unlit_glb import unlit_glb
from surfkit.apps.view.viewer_scene import ViewerScene
from surfkit.compress.levels.lod_tree import LodBlock, LodTree
from surfkit.core.check import BadInput
from surfkit.io.splats.splat_table import SplatTable
from surfkit.mesh.base import Mesh
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View


def table(count=200, kind="gaussian", seed=0):
    draw = torch.Generator().manual_seed(seed)
    axes = 3 if kind == "gaussian" else 2
    return SplatTable(
        kind,
        torch.randn(count, 3, generator=draw),
        torch.randn(count, 4, generator=draw),
        torch.randn(count, axes, generator=draw) - 4,
        torch.randn(count, generator=draw),
        torch.randn(count, 3, generator=draw),
        torch.zeros(count, 0, 3),
    )


@pytest.mark.parametrize("kind", ["gaussian", "surfel"])
def test_covariances_are_those_of_the_ellipsoids(kind):
    splats = table(kind=kind)
    found = drawn(splats)
    turns = Rotation.from_quat(splats.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    scales = np.exp(splats.ellipsoid_log_scales().double().numpy())
    exact = np.einsum("nij,nj,nkj->nik", turns, scales**2, turns)
    assert np.allclose(found.covariances * found.unit**2, exact, rtol=1e-4, atol=1e-9)
    halves = found.covariances.astype(np.float16)
    assert np.isfinite(halves).all()
    largest = np.linalg.eigvalsh(found.covariances)[:, 2]
    assert np.allclose(np.linalg.eigvalsh(halves.astype(np.float64))[:, 2], largest, rtol=5e-3), "16 bits are enough"
    assert np.allclose(found.rgb, 255 * (0.5 + 0.2820948 * splats.sh0.numpy()).clip(0, 1), atol=0.51)
    assert np.allclose(found.opacities, torch.sigmoid(splats.opacity_logits).numpy())


def test_a_huge_splat_stays_finite():
    splats = table()
    splats.log_scales[3] = 40.0
    found = drawn(splats)
    assert np.isfinite(found.covariances.astype(np.float16)).all()


def test_a_budget_of_points():
    assert some(10, 3).tolist() == [0, 4, 9] and len(some(0, 5)) == 0 and some(3, 9).tolist() == [0, 1, 2]


def test_a_budget_takes_a_level_of_detail_where_there_is_one():
    primitive = Gaussian3D(sh_degree=0)
    sizes = (100, 30, 8)
    models = [SplatModel(primitive, primitive.from_table(table(n), torch.Generator())) for n in sizes]
    blocks = [LodBlock(2, 0, 8, -1, 2.0), LodBlock(1, 0, 30, 0, 1.0), LodBlock(0, 0, 100, 1, 0.0)]
    tree = LodTree.of(np.arange(100), models, blocks)
    subject = ViewerScene(Path("s"), Frame(np.zeros(3), 1.0), np.array([0.0, 0, 1]), table(100), levels=tree)
    for budget, count, said in ((100, 100, "all 100"), (40, 30, "level of detail 1"), (8, 8, "2 stand for 100")):
        found, told = SharedCache(subject).within(budget)
        assert len(found) == count and said in told
    found, told = SharedCache(subject).within(5)
    assert len(found) == 5 and told.startswith("5 splats, drawn by lot")
    found, told = SharedCache(replace(subject, levels=None)).within(40)
    assert len(found) == 40 and told.startswith("40 splats, drawn by lot") and "surfkit lod" not in told


def test_splats_in_their_places():
    found = drawn(table(20))
    places = np.random.default_rng(0).permutation(50)[:20]
    spread = found.placed(places, 50)
    free = np.setdiff1d(np.arange(50), places)
    for name in ("means", "covariances", "rgb", "opacities"):
        assert np.array_equal(getattr(spread, name)[places], getattr(found, name))
    assert len(spread.means) == 50 and not spread.opacities[free].any() and spread.unit == found.unit


def test_covariances_of_a_choice_are_in_the_unit_of_the_model():
    splats = table(300)
    shelf = SharedCache(ViewerScene(Path("s"), Frame(np.zeros(3), 1.0), np.array([0.0, 0, 1]), splats))
    whole, some_of_it = shelf.drawn(splats, "as trained"), shelf.drawn(splats.take(slice(0, 7)), "as trained")
    assert some_of_it.unit == whole.unit and np.allclose(some_of_it.covariances, whole.covariances[:7])


def grid(n, bend=0.0):
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    vertices = np.stack([x, y, bend * np.sin(6 * x)], axis=2).reshape(-1, 3).astype(np.float32)
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return Mesh(vertices, faces, np.round(255 * np.stack([x, y, 0 * x], 2).reshape(-1, 3)).astype(np.uint8))


def test_a_coarser_mesh_is_the_same_surface():
    mesh = grid(120, 0.2)
    for budget in (10_000, 2_000):
        coarse = fewer_faces(mesh, budget)
        assert budget / 4 < len(coarse.faces) <= budget and coarse.faces.max() < len(coarse.vertices)
        away = np.abs(coarse.vertices[:, 2] - 0.2 * np.sin(6 * coarse.vertices[:, 0]))
        side = math.sqrt(2 / budget)
        assert away.max() < 0.2 * 36 * side**2, "within the cells"
        a, b, c = (coarse.vertices[coarse.faces[:, k]] for k in range(3))
        flat = np.cross(b - a, c - a)[:, 2]
        assert np.abs(flat).sum() / 2 == pytest.approx(1, abs=4 * side)
        assert np.allclose(coarse.colors[:, :2] / 255, coarse.vertices[:, :2], atol=0.01)
    assert fewer_faces(mesh, len(mesh.faces)) is mesh
    assert len(fewer_faces(grid(120), 1).faces) <= 1


def test_a_coarser_mesh_has_the_means_of_its_values():
    x = np.linspace(0, 1, 33, dtype=np.float32)
    places = np.stack([*np.meshgrid(x, x), np.zeros((33, 33))], 2).reshape(-1, 3).astype(np.float32)
    at = np.arange(33 * 33).reshape(33, 33)
    faces = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, :-1]], 2).reshape(-1, 3).astype(np.int32)
    small = fewer_faces(Mesh(places, faces, values={"views": places[:, 0].copy()}), 200)
    assert len(small.faces) <= 200 and small.values["views"] == pytest.approx(small.vertices[:, 0], abs=1e-6)


def test_a_mesh_for_a_browser_is_read_by_trimesh():
    trimesh = needs("trimesh")
    mesh = grid(12, 0.3)
    (loaded,) = trimesh.load(io.BytesIO(unlit_glb(mesh)), file_type="glb", process=False).geometry.values()
    assert np.allclose(loaded.vertices, mesh.vertices) and np.array_equal(loaded.faces, mesh.faces)
    back = np.asarray(loaded.visual.vertex_attributes["color"], np.float64)
    srgb = np.where(back <= 0.0031308, back * 12.92, 1.055 * back ** (1 / 2.4) - 0.055)
    assert np.abs(srgb * 255 - mesh.colors).max() < 0.02


def test_colours_say_what_they_say():
    splats = table(kind="surfel")
    up = np.array([0.0, 0.0, 1.0])
    normals = normals_of(splats, up)
    turns = Rotation.from_quat(splats.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    assert np.allclose(np.abs((normals * turns[:, :, 2]).sum(1)), 1, atol=1e-5) and (normals[:, 2] >= 0).all()
    colors = by_normal(np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]), np.eye(3))
    assert colors.tolist() == [[255, 128, 128], [128, 255, 128], [128, 128, 255]]
    thin = replace(table(1), quats=torch.tensor([[1.0, 0, 0, 0]]), log_scales=torch.tensor([[-9.0, -3, -3]]))
    assert np.allclose(np.abs(normals_of(thin, up)), [[1, 0, 0]]), "across the thinnest axis"
    heights = np.linspace(0, 10, 101)
    bounds = height_bounds(heights)
    assert bounds == pytest.approx((0.2, 9.8))
    shades = by_height(heights, bounds).sum(1).astype(int)
    assert (np.diff(shades) >= 0).all() and shades[0] < 200 < 600 < shades[-1]
    assert by_block(np.array([0, 7, 1, -1])).tolist()[0] == by_block(np.array([7])).tolist()[0]
    assert by_block(np.array([-1])).tolist() == [[128] * 3]


def seen(tmp_path, size=(40, 30)):
    path = tmp_path / "a.png"
    Image.fromarray(np.full((size[1], size[0], 3), 100, np.uint8)).save(path)
    pose = torch.eye(4, dtype=torch.float64)
    return View("a.png", Camera(pose, 30.0, 30.0, size[0] / 2, size[1] / 2, *size), path)


def maps(view, value=100 / 255, depth=2.0):
    height, width = view.camera.height, view.camera.width
    return Maps(
        color=torch.full((3, height, width), value),
        alpha=torch.ones(height, width),
        median=torch.linspace(depth, 2 * depth, height * width).reshape(height, width),
        normal=torch.tensor([0.0, 0.0, -1.0])[:, None, None].expand(3, height, width),
    )


def test_errors_are_the_differences_to_the_photograph(tmp_path):
    view, frame = seen(tmp_path), Frame(np.zeros(3), 0.1, 1.0)
    exact, told = picture(view, "error", maps, frame)
    assert "mean 0.0%" in told and "PSNR infinite" in told and (exact == exact[0, 0]).all()
    off, told = picture(view, "error", lambda v: maps(v, 100 / 255 + 0.1), frame)
    assert "mean 10.0%" in told and "PSNR 20.00 dB" in told and off.sum() > exact.sum()
    assert np.array_equal(picture(view, "error", lambda v: maps(v, 100 / 255 - 0.1), frame)[0], off), "without its sign"
    worst = error_picture(maps(view, 1.0), torch.zeros(3, 30, 40))[0]
    assert np.array_equal(worst, error_picture(maps(view, WORST_ERROR), torch.zeros(3, 30, 40))[0])


def test_pictures_of_a_camera(tmp_path):
    view, frame = seen(tmp_path), Frame(np.zeros(3), 0.1, 1.0)
    photo, _ = picture(view, "photograph", None, frame)
    assert photo.shape == (30, 40, 3) and (photo == 100).all()
    assert (picture(view, "render", lambda v: maps(v, 0.5), frame)[0] == 128).all()
    depth, told = picture(view, "depth", maps, frame)
    assert "20.4 m" in told and "39.6 m" in told and depth[0, 0].sum() > depth[-1, -1].sum()
    assert "units" in picture(view, "depth", maps, Frame(np.zeros(3), 0.1))[1]
    assert picture(view, "normal", maps, frame)[0][0, 0].tolist() == [128, 128, 255]
    large = seen(tmp_path, (3300, 20))
    assert picture(large, "render", maps, frame)[0].shape[1] == 1600
    assert max(thumbnail(large, 160).shape) <= 330


def test_what_cannot_be_drawn_is_said(tmp_path):
    view, frame = seen(tmp_path), Frame(np.zeros(3), 1.0)
    with pytest.raises(BadInput, match="cannot be drawn"):
        picture(view, "render", None, frame)
    with pytest.raises(BadInput, match="no normals"):
        picture(view, "normal", lambda v: replace(maps(v), normal=None), frame)
    with pytest.raises(BadInput, match="no such photograph"):
        picture(replace(view, path=Path("nowhere.png")), "error", maps, frame)
    assert picture(view, "depth", lambda v: replace(maps(v), median=torch.zeros(30, 40)), frame)[1] == "nothing is seen"


def test_the_window_shows_all_of_a_photograph(tmp_path):
    camera = seen(tmp_path).camera
    assert whole_view(camera, 2.0) == pytest.approx(2 * math.atan(15 / 30)), "the height decides in a wide window"
    assert whole_view(camera, 1.0) == pytest.approx(2 * math.atan(20 / 30)), "the width in a narrow one"
