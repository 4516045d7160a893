"""Pairs against the geometry of two cameras, stereo against surfaces of known depth, and the contract of meshers."""

import math
from dataclasses import replace

import numpy as np
import pytest
import surfkit_gs2mesh
import torch
from surfkit_gs2mesh.pair import Pair, consistent, estimate
from surfkit_gs2mesh.rendered_stereo import RenderedStereo

from surfkit.core.codec import dump, load
from surfkit.core.registry import plugins
from surfkit.depth import DepthAnythingV2, PlaneSweep
from surfkit.mesh.tsdf import TSDF
from surfkit.plugin import BadInput, Camera, Maps, Mesher, View, components
from surfkit.raster.native import module
from surfkit.testing import check
from surfkit.testing.inputs import mesh_input

compiled = pytest.mark.skipif(module() is None, reason="surfkit was installed without its compiled part")
NORMAL, OFFSET = torch.tensor([0.25, -0.15, -1.0]).double(), -1.0
"""The slanted plane NORMAL . point = OFFSET of the world."""
FRONT = 0.6
"""World z of a square, half as far as the plane."""


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = RenderedStereo in components(Mesher).values()
    if not there:
        plugins().register(surfkit_gs2mesh, "gs2mesh of this test")
    yield
    if not there:
        plugins().unregister(surfkit_gs2mesh)


def camera(width=128, height=96) -> Camera:
    """Turned a little, its principal point off the middle."""
    angle = 0.1
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[1, 1] = math.cos(angle)
    pose[0, 1], pose[1, 0] = -math.sin(angle), math.sin(angle)
    pose[:3, 3] = torch.tensor([0.02, -0.01, 0.0])
    return Camera(pose, 130.0, 130.0, width / 2 + 2.5, height / 2 - 1.5, width, height)


def texture(points: torch.Tensor) -> torch.Tensor:
    """(3, ...) colours of places: waves of many directions and lengths."""
    draw, total = torch.Generator().manual_seed(5), torch.zeros(3, *points.shape[1:], dtype=torch.float64)
    for wave in range(24):
        way = torch.randn(3, 3, generator=draw).double() * (6 + 2.5 * wave)
        total += torch.sin(torch.einsum("cd,d...->c...", way, points) + wave) / 24**0.5
    return (0.5 + 0.3 * total).clamp(0, 1)


def look(eye: Camera, square: bool = False) -> tuple[Maps, torch.Tensor]:
    """What a camera sees of the plane, and of a square before it: exact, one ray a pixel."""
    pose, rays = eye.world_to_camera, eye.rays(torch.float64)
    ways = torch.einsum("dc,dhw->chw", pose[:3, :3], rays)
    start = eye.centre[:, None, None]
    z = (OFFSET - NORMAL @ eye.centre) / torch.einsum("c,chw->hw", NORMAL, ways)
    if square:
        near = (FRONT - eye.centre[2]) / ways[2]
        at = start + near * ways
        z = torch.where((at[0].abs() < 0.12) & (at[1].abs() < 0.12), near, z)
    points = start + z * ways
    depth = z.float()
    return Maps(texture(points).float(), torch.ones_like(depth), depth, depth), points


def stereo(pair: Pair, folder, square=False, estimator=None, tolerance_px=3.0):
    pictures = [look(eye, square)[0].color for eye in pair.cameras]
    return estimate(pair, pictures, estimator or RenderedStereo().estimator, tolerance_px, folder)


def test_disparity_is_how_far_a_point_moves_along_its_row():
    pair = Pair(camera(), 0.08, 4, 20)
    _, points = look(pair.left)
    flat = points.flatten(1).T
    left, right = (eye.project(flat) for eye in pair.cameras)
    assert torch.allclose(left[:, 1:], right[:, 1:], atol=1e-9), "same row, same depth"
    moved = (left[:, 0] - right[:, 0]).view(96, 128)
    assert torch.allclose(pair.disparity(1 / left[:, 2].view(96, 128)), moved, atol=1e-9)
    wide = Pair(camera(), 0.08, 1, 1000)
    assert torch.allclose(wide.depth(moved), left[:, 2].view(96, 128), atol=1e-9), "and back"
    cut = Pair(camera(), 0.08, 12, 13).depth(moved)
    z = left[:, 2].view(96, 128)
    assert torch.equal(cut > 0, (z >= 12 * 0.08) & (z <= 13 * 0.08)) and 0 < (cut > 0).double().mean() < 1
    half = pair.disparity(torch.full((48, 64), 2.0))
    assert half.shape == (96, 128) and torch.allclose(half, torch.tensor(2 * 130 * 0.08)), "pixels of the view"


def test_the_points_span_the_depths_evenly_in_the_inverse_and_both_see_them():
    pair = Pair(camera(), 0.08, 4, 20)
    xyz = pair.points()
    for eye in pair.cameras:
        at = eye.project(xyz)
        assert (at[:, 0] > 0).all() and (at[:, 0] < 128).all() and (at[:, 1] > 0).all() and (at[:, 1] < 96).all()
    share = (0.08 / at[:, 2] - 1 / 20) / (1 / 4 - 1 / 20)
    assert share.min() >= 0 and share.max() <= 1
    counts = torch.histc(share, 4, 0, 1)
    assert (counts > 0.2 * len(xyz)).all()


def test_the_check_of_left_and_right_is_that_of_a_loop():
    draw = torch.Generator().manual_seed(0)
    left, right = (torch.rand(12, 20, generator=draw) * 6 for _ in range(2))
    left[3, 4] = right[5, 6] = 0
    wanted = torch.zeros(12, 20, dtype=torch.bool)
    for y in range(12):
        for x in range(20):
            d, to = float(left[y, x]), math.floor(x + 0.5 - float(left[y, x]))
            found = float(right[y, to]) if 0 <= to < 20 else 0
            wanted[y, x] = d > 0 and found > 0 and abs(d - found) <= 1.5
    assert torch.equal(consistent(left, right, 1.5), wanted) and 20 < wanted.sum() < 200


@compiled
def test_a_slanted_plane_is_found_where_it_is(tmp_path):
    pair = Pair(camera(), 0.09, 4, 20)
    truth = look(pair.left)[0].depth
    found = stereo(pair, tmp_path)
    there = found.depth > 0
    off = (found.depth / truth - 1).abs()[there]
    assert there[:, 16:].double().mean() > 0.9, "but for what the right picture does not show"
    assert off.median() < 0.005 and (off < 0.02).double().mean() > 0.98
    rotation = pair.left.world_to_camera[:3, :3]
    normal = rotation @ (NORMAL / NORMAL.norm())
    cosine = torch.einsum("c,chw->hw", normal.float(), found.normal)[there]
    assert cosine.median() > math.cos(math.radians(15))


@compiled
def test_any_aligned_estimator_can_take_its_place(tmp_path):
    pair = Pair(camera(), 0.09, 4, 20)
    truth = look(pair.left)[0].depth
    found = stereo(pair, tmp_path, estimator=PlaneSweep(longest=64, tolerance=0.1, edge=0.3))
    there = found.depth > 0
    assert found.depth.shape == truth.shape, "maps of another size are resized"
    assert there.double().mean() > 0.6 and (found.depth / truth - 1).abs()[there].median() < 0.02


@compiled
def test_what_only_one_side_sees_has_no_depth(tmp_path):
    pair = Pair(camera(), 0.09, 4, 20)
    truth, points = look(pair.left, square=True)
    in_right = pair.right.project(points.flatten(1).T)
    x, y = (in_right[:, k].long().clamp(0, top) for k, top in ((0, 127), (1, 95)))
    seen = look(pair.right, square=True)[0].depth[y, x]
    hidden = (seen < 0.8 * in_right[:, 2]).view(96, 128)
    assert hidden.sum() > 200, "the plane beside the square"
    found = stereo(pair, tmp_path, square=True)
    wrong = (found.depth > 0) & ((found.depth / truth.depth - 1).abs() > 0.05)
    assert (wrong & hidden).sum() < 0.15 * hidden.sum() and wrong.double().mean() < 0.02


def ball(**changes):
    """The ball of `mesh_input`, with a random colour for every splat."""
    given = mesh_input("gaussian", count=3000, views=6)
    colors = (texture(2 * given.splats.means.T.double()).T.float() - 0.5) / 0.2821
    scales = given.splats.scales * 0.6
    splats = replace(given.splats, sh0=colors[:, None].contiguous(), scales=scales)

    def draw(view: View) -> Maps:
        return given.rasterizer.render(splats, view.camera, 0.01, True, False).maps

    return replace(given, splats=splats, draw=draw, priors=None, photo=None, **changes)


@compiled
def test_the_mesher_finds_a_ball_in_renders_and_cleans_up(tmp_path):
    quick = replace(RenderedStereo().estimator, coarsest=40)
    mesher = RenderedStereo(baseline=0.2, estimator=quick, fusion=TSDF(carve=False))
    given = ball(scratch=tmp_path)
    check(mesher, replace(given, views=given.views[:3]))
    mesh = mesher.mesh(given)
    radius = float(given.splats.means.norm(dim=1).mean())
    away = np.abs(np.linalg.norm(mesh.vertices, axis=1) - radius)
    assert np.median(away) < 0.02 * radius and np.quantile(away, 0.9) < 0.08 * radius
    assert not list(tmp_path.iterdir()) and 0 < mesh.facts["share_with_stereo_depth"] < 1


@compiled
def test_nothing_in_the_range_is_refused_with_a_remedy(tmp_path):
    given = ball(scratch=tmp_path)
    with pytest.raises(BadInput, match="4 to 20.*--mesh.baseline"):
        RenderedStereo(baseline=0.01).mesh(replace(given, views=given.views[:1]))
    assert not list(tmp_path.iterdir())
    with pytest.raises(BadInput, match="mesh.nearest is 0.1.*larger"):
        RenderedStereo(nearest=0.1, farthest=0.2).mesh(ball(scratch=tmp_path))
    with pytest.raises(BadInput, match="no views"):
        RenderedStereo().mesh(ball(views=()))


@pytest.mark.parametrize(
    "setting",
    [{"baseline": 0.0}, {"nearest": 30.0}, {"farthest": 1e9}, {"tolerance_px": 0.0}, {"estimator": DepthAnythingV2()}],
)
def test_settings_that_make_no_sense_are_refused(setting):
    with pytest.raises(BadInput, match=next(iter(setting))):
        RenderedStereo(**setting)


def test_the_recipe_is_3dgs_with_this_mesher_and_says_what_stands_in():
    recipe = surfkit_gs2mesh.surfkit_recipes()["gs2mesh"]
    assert load(type(recipe), dump(recipe)) == recipe and "in place of its network" in recipe.about
    row = surfkit_gs2mesh.surfkit_rows()["methods"][0]
    assert row.label == "GS2Mesh (own stereo)" and row.recipe == recipe
