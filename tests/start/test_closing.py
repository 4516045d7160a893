"""Surfaces that close what trusted depth sees into: compiled against numpy, columns by hand, and an alley whose walls
and ground are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native
from scipy.spatial import cKDTree

from surfkit.core.check import BadInput
from surfkit.core.events import Warned
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.scene.camera import Camera
from surfkit.start import carving_grid as carve
from surfkit.start import space_carving as closing
from surfkit.start.base import StartInput
from surfkit.start.carving_grid import CarvingGrid, Votes, meet, solid_of, votes
from surfkit.start.space_carving import not_seen_through
from surfkit.start.stereo_start import StereoStart
from surfkit.start.voxels import Samples
from surfkit.testing import synthetic
from surfkit.testing.synthetic import Box, Flight, GroundPlane, photograph

ALLEY = (GroundPlane(), Box((-5.0, -4.0, 0.0), (-1.0, 4.0, 4.0)), Box((1.0, -4.0, 0.0), (5.0, 4.0, 4.0)))
"""Two houses, 2 m apart and 4 m high."""


@pytest.fixture(scope="module")
def town():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "SURFACES", ALLEY)
        return photograph(Flight(kind="grid", views=25, width=160, height=120, points=600, test_every=0))


def places_of(town, view, depth):
    """(3, H, W) of the pixels, metres."""
    local = view.camera.rays(torch.float64) * depth
    turn, shift = view.camera.world_to_camera[:3, :3], view.camera.world_to_camera[:3, 3:]
    world = (turn.T @ (local.flatten(1) - shift)).T.numpy()
    return town.scene.frame.to_input(world).T.reshape(local.shape)


def in_alley(places, below):
    x, y, z = places
    return (np.abs(x) < 1.01) & (np.abs(y) < 4) & (z < below)


def known(town, below=3.0, masks=None, wrong=1.5):
    """What a start is given: exact depth, but in the alley below a height, where it is not trusted, and too near
    by a factor."""
    priors = []
    for view in town.scene.train:
        depth = town.exact[view.name].depth
        lost = torch.from_numpy(in_alley(places_of(town, view, depth), below))
        inverse = torch.where(depth > 0, 1 / depth, 0).float()
        priors.append(DepthPrior(torch.where(lost, wrong * inverse, inverse), (~lost & (inverse > 0)).float(), 0.7))
    photos = [(town.exact[view.name].color * 255).round().to(torch.uint8) for view in town.scene.train]
    return StartInput(town.scene, photos, masks, priors, torch.Generator().manual_seed(0))


def test_walls_and_ground_of_an_alley_that_no_depth_is_trusted_in(town):
    given = known(town)
    stereo = StereoStart(points=6_000).fused(given)
    assert not in_alley(town.scene.frame.to_input(stereo.xyz).T, 2.9).any()
    found = StereoStart(points=20_000, closing=0.2).closed(given, stereo)
    places = town.scene.frame.to_input(found.xyz)
    inside = in_alley(places.T, 2.9)
    off = np.min([shape.distance(places) for shape in ALLEY], axis=0)
    side = float(np.median(stereo.size)) / town.scene.frame.scale
    assert inside.sum() > 50 and np.median(off[inside]) < 0.5 * side and (off[inside] < side).mean() > 0.8
    ground, wall = inside & (places[:, 2] < side), inside & (places[:, 2] > side)
    assert ground.sum() > 10 and wall.sum() > 10
    level = ground & (np.abs(places[:, 0]) < 0.6)  # not in the corners; the axes of the frame are those of the input
    assert (found.normals[level] @ [0, 0, 1] > 0.8).mean() > 0.8
    toward = found.normals[wall][:, 0] * np.sign(places[wall][:, 0])
    assert (toward < -0.6).mean() > 0.7  # walls face the alley
    assert cKDTree(stereo.xyz).query(found.xyz)[0].min() >= 0.75 * stereo.size.min()


def test_depth_that_is_not_trusted_is_used_where_nothing_contradicts_it(town):
    """Exact here: points lie on the surface itself, not on the border of voxels; where it is too near, the views
    that look down see through it, and it makes no points."""
    start, off = StereoStart(points=20_000, closing=0.2), {}
    for wrong in (1.0, 1.5):
        given = known(town, wrong=wrong)
        stereo = StereoStart(points=6_000).fused(given)
        found = start.closed(given, stereo)
        places = town.scene.frame.to_input(found.xyz)
        inside = in_alley(places.T, 2.9)
        side = float(np.median(stereo.size)) / town.scene.frame.scale
        off[wrong] = np.min([shape.distance(places[inside]) for shape in ALLEY], axis=0) / side
    assert len(off[1.0]) > 50 and (off[1.0] < 1e-3).mean() > 0.5 > 10 * (off[1.5] < 1e-3).mean()


def test_points_that_more_see_through_than_see_are_left_out():
    grid = CarvingGrid(np.array([1.0, 2.0, 3.0]), np.eye(3)[[1, 2, 0]], 0.5, (4, 3, 2))
    surfaces, through = np.zeros((2, 4, 3, 2), np.uint8)
    through[1, 2, 1], through[3, 0, 0], surfaces[3, 0, 0] = 1, 2, 2
    voxels = np.array([[1, 2, 1], [3, 0, 0], [0, 1, 1], [4, 0, 0], [0, -1, 0]])
    places = grid.origin + 0.5 * (voxels + [0.4, -0.4, 0.3]) @ grid.axes
    given = Samples(places, np.arange(15.0).reshape(5, 3), np.eye(3)[[0, 1, 2, 0, 1]], np.ones(5), np.full(5, 0.1))
    kept = not_seen_through(grid, Votes(surfaces, through), given)
    np.testing.assert_array_equal(kept.rgb, given.rgb[[1, 2]])
    np.testing.assert_array_equal(kept.xyz, places[[1, 2]])
    np.testing.assert_array_equal(kept.normals, given.normals[[1, 2]])
    assert kept.weight.tolist() == [1, 1] and kept.grain.tolist() == [0.5, 0.5]


def test_the_cloud_has_them_at_an_opacity_of_their_own_and_0_leaves_them_out(town, monkeypatch):
    given, start = known(town), StereoStart(points=20_000, spacing_px=2.0, closing=0.2)
    cloud, without = start.cloud(given), replace(start, closing=0.0).cloud(given)
    extra = (cloud.opacity == 0.2).sum()
    assert extra > 20 and len(cloud.xyz) == len(without.xyz) + extra and not (without.opacity == 0.2).any()
    shapes = {len(value) for value in vars(cloud).values() if torch.is_tensor(value)}
    assert shapes == {len(cloud.xyz)} and torch.allclose(
        cloud.normals.norm(dim=1), torch.ones(len(cloud.xyz)), atol=1e-4
    )
    again = start.cloud(known(town))
    assert all(torch.equal(value, vars(again)[name]) for name, value in vars(cloud).items() if torch.is_tensor(value))
    stereo = start.fused(given)
    told = []
    monkeypatch.setattr(closing, "emit", told.append)
    few = StereoStart(points=len(stereo) + 10, closing=0.2)
    assert len(few.closed(given, stereo)) == 10 and len(StereoStart(points=100, closing=0.2).closed(given, stereo)) == 0
    left = [event.text for event in told if isinstance(event, Warned)]
    assert len(left) == 2 and "10 are used" in left[0] and "no initial points" in left[1]


def test_nothing_is_added_where_all_depth_is_trusted_or_masked(town):
    start = StereoStart(points=6_000, closing=0.2)
    trusted = known(town, below=-1.0)
    assert len(start.closed(trusted, start.fused(trusted))) == 0
    lost = [torch.from_numpy(~in_alley(places_of(town, v, town.exact[v.name].depth), 3.0)) for v in town.scene.train]
    masked = known(town, masks=lost)
    assert len(StereoStart(points=20_000, closing=0.2).closed(masked, start.fused(masked))) == 0


def test_points_that_are_further_apart_in_a_large_scene_are_told(town, monkeypatch):
    given = known(town)
    stereo = StereoStart(points=6_000).fused(given)
    monkeypatch.setattr(CarvingGrid.around.__func__, "__defaults__", (20_000,))
    told = []
    monkeypatch.setattr(closing, "emit", told.append)
    StereoStart(points=20_000, closing=0.2).closed(given, stereo)
    assert any(isinstance(event, Warned) and "times as far apart" in event.text for event in told)


@pytest.mark.parametrize("value", [-0.1, 1.0, float("nan")])
def test_an_opacity_that_is_none_is_refused(value):
    with pytest.raises(BadInput, match=r"start\.closing"):
        StereoStart(closing=value)


def test_columns_by_hand():
    """Below free space what is unknown is free down to the ground, below a roof it is solid."""
    surfaces, through = np.zeros((2, 40, 40, 12), np.uint8)
    surfaces[..., 1] = 9  # ground
    surfaces[:, 20:, 8] = 3  # roofs; the ground below them is not seen
    surfaces[:, 20:, 1] = 0
    through[..., 9:] = 4
    through[:, :20, 6:9] = 1  # into the alley, down to here
    surfaces[10, 5, 7] = through[10, 5, 7] = 2  # as often seen as seen through
    through[10, 5, 6] = 0
    found = solid_of(Votes(surfaces, through))
    assert found[10, 5, :8].all(), "below what is solid"
    found[10, 5] = found[10, 6]
    assert not found[..., 9:].any() and not found[:, :20, 2:].any(), "below free space it is free"
    assert found[:, 20:, :9].all() and found[:, :20, :2].all(), "below a roof, and from the ground on, it is solid"
    lonely = np.zeros_like(surfaces)
    lonely[..., 8] = 1  # a surface that one view sees is no roof
    assert not solid_of(Votes(lonely, through)).any()


def scattered(seed):
    """A grid, turned, and cameras around it with random depths."""
    draw = np.random.default_rng(seed)
    axes = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    axes *= np.linalg.det(axes)
    grid = CarvingGrid(draw.normal(size=3), axes, 0.1, (17, 12, 9))
    middle = grid.origin + axes.T @ (0.5 * grid.side * np.array(grid.size))
    maps = []
    for _ in range(6):
        turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(turn)
        pose[:3, 3] = torch.from_numpy(np.array([0, 0, 1.0]) - turn @ middle)
        depth = torch.from_numpy(draw.uniform(0.3, 2.0, (20, 30))) * torch.from_numpy(draw.random((20, 30)) < 0.8)
        maps.append((Camera(pose, 24.0, 26.0, 14.0, 11.0, 30, 20), depth.float()))
    return grid, maps, draw


@needs_native
@pytest.mark.parametrize("threads", [1, 2])
def test_compiled_votes_and_rays_are_those_of_numpy(monkeypatch, threads):
    grid, maps, draw = scattered(3)
    solid = (draw.random(grid.size) < 0.05).astype(np.uint8)
    rays = np.concatenate([draw.uniform(-0.6, 0.6, (500, 2)), np.ones((500, 1))], 1)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        fast = votes(grid, maps), [meet(grid, solid, camera, rays) for camera, _ in maps]
    finally:
        torch.set_num_threads(before)
    monkeypatch.setattr(carve, "module", lambda: None)
    slow = votes(grid, maps), [meet(grid, solid, camera, rays) for camera, _ in maps]
    for name in ("surfaces", "through"):
        found, wanted = getattr(fast[0], name), getattr(slow[0], name)
        assert wanted.max() > 2 and (found != wanted).mean() < 1e-3  # roundings of pixels
    for (depth, normal), (wanted, way) in zip(fast[1], slow[1], strict=True):
        assert (wanted > 0).mean() > 0.2
        same = np.isclose(depth, wanted, rtol=1e-5)
        assert same.mean() > 0.995
        np.testing.assert_allclose(normal[same], way[same], atol=1e-5)


def test_counts_end_at_255():
    grid, maps, _ = scattered(5)
    found = votes(grid, maps[:1] * 300)
    assert found.through.max() == 255 and set(np.unique(found.through)) == {0, 255}


def test_rays_meet_a_wall_where_it_is():
    grid = CarvingGrid(np.zeros(3), np.eye(3), 0.5, (40, 40, 40))
    solid = np.zeros(grid.size, np.uint8)
    solid[:, :, 30:] = 1  # from z = 14.75 on
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-10.0, -10.0, 5.0])  # 5 in front of the grid
    camera = Camera(pose, 10.0, 10.0, 5.0, 5.0, 10, 10)
    depth, normal = meet(grid, solid, camera, np.array([[0, 0, 1.0], [0.3, -0.2, 1.0], [0, 0, -1.0], [30.0, 0, 1.0]]))
    assert np.abs(depth[:2] - 19.75).max() < 0.25 + 1e-6 and (depth[2:] == 0).all()
    np.testing.assert_allclose(normal[:2], [[0, 0, -1], [0, 0, -1]], atol=1e-6)


def test_a_grid_stays_within_its_number_of_voxels():
    points = np.random.default_rng(0).uniform(-50, 50, (5000, 3))
    small, large = CarvingGrid.around(points, np.eye(3), 1.0), CarvingGrid.around(points, np.eye(3), 1.0, most=30_000)
    assert small.side == 1.0 and np.prod(large.size) <= 30_000 and large.side > 1.0
    low = large.origin
    high = large.origin + large.side * (np.array(large.size) - 1)
    assert ((points > low) & (points < high)).all(1).mean() > 0.98


def test_a_forecast_counts_them():
    without, with_them = (StereoStart(closing=value).expected(0, 900_000) for value in (0.0, 0.2))
    assert without == 10_000 and with_them == 16_000
    assert StereoStart(closing=0.2, most=12_000).expected(0, 900_000) == 12_000
