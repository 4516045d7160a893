"""The plane sweep on a scene of which every depth is known, and each of its steps against plain loops."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.core.check import BadInput
from surfkit.depth.base import DepthInput
from surfkit.depth.consistency import DepthConsistency, agreement, agreement_in_torch, at_edge
from surfkit.depth.cost_volume import PosedImage, cost_volume, ray_map
from surfkit.depth.neighbours import depth_range, neighbours
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.depth.semi_global_matching import best_planes, smooth_costs
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.scene.camera import Camera
from surfkit.testing.synthetic import Flight, photograph, write_colmap

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """An aerial grid over the box and the ball: folder, scene, observations and truth."""
    torch.set_num_threads(2)
    folder = tmp_path_factory.mktemp("farm")
    truth = photograph(Flight(kind="grid", views=20, width=120, height=90, points=600, test_every=0))
    write_colmap(folder, truth, tracks=True)
    data = Data(folder, test_every=0)
    scene = read(data)
    return scene, observations(data, scene), truth


@pytest.fixture(scope="module")
def swept(farm, tmp_path_factory):
    """Estimates of two views."""
    scene, observations, _ = farm
    given = DepthInput(scene.train, observations, CPU, tmp_path_factory.mktemp("work"))
    return list(PlaneSweep().estimate(given, [7, 12]))


def test_depth_is_within_one_percent_where_it_is_trusted(farm, swept):
    scene, _, truth = farm
    for estimate, at in zip(swept, [7, 12], strict=True):
        depth = truth.exact[scene.train[at].name].depth.float()
        trusted = (estimate.confidence > 0.5) & (depth > 0)
        error = (1 / (estimate.inverse * depth) - 1).abs()[trusted]
        assert estimate.at == at and trusted.float().mean() > 0.35
        assert error.median() < 0.006 and (error < 0.02).float().mean() > 0.9
        everywhere = (1 / (estimate.inverse * depth) - 1).abs()[depth > 0]
        assert (everywhere > 0.05).float().mean() > 0.01  # so the check had something to reject


@needs_native
def test_the_compiled_estimator_finds_the_same_depth_within_a_pixel_of_parallax(farm, swept, tmp_path):
    scene, observations, _ = farm
    given = DepthInput(scene.train, observations, CPU, tmp_path)
    pixel = 0.026  # of parallax, as a share of depth
    for one, other in zip(PatchMatch(coarsest=60).estimate(given, [7, 12]), swept, strict=True):
        both = (one.confidence >= 0.375) & (other.confidence >= 0.375)
        apart = (one.inverse / other.inverse - 1).abs()[both]
        assert both.float().mean() > 0.45
        assert apart.median() < pixel / 4 and (apart < pixel).float().mean() > 0.98


def test_exposure_does_not_matter(farm, tmp_path):
    scene, observations, _ = farm
    sweep, given = PlaneSweep(), DepthInput(scene.train, observations, CPU, tmp_path)
    near = neighbours(scene.train, observations, 2, 8)[7]
    here, others = sweep.picture(given, 7), [sweep.picture(given, other) for other in near]
    planes = torch.linspace(*depth_range(scene.train[7], observations, 0.1), 8)
    darker = [replace(other, color=0.7 * other.color + 0.1) for other in others]
    plain, dark = (cost_volume(here, each, planes, 5, 0.5) for each in (others, darker))
    assert (plain - dark).abs().mean() < 0.03 < 0.1 < plain.std()


def test_ray_map_is_the_projection_of_the_point(farm):
    scene, _, _ = farm
    here, there = scene.train[0].camera, scene.train[5].camera
    a, b = ray_map(here, there, CPU)
    c, y, x = 0.9, 17, 101
    ray = torch.tensor([(x + 0.5 - here.cx) / here.fx, (y + 0.5 - here.cy) / here.fy, 1.0, c], dtype=torch.float64)
    world = torch.linalg.inv(here.world_to_camera) @ (ray / c)
    local = (there.world_to_camera @ world)[:3]
    wanted = torch.stack([there.fx * local[0] / local[2] + there.cx, there.fy * local[1] / local[2] + there.cy])
    found = a[:, y, x] + c * b
    torch.testing.assert_close((found[:2] / found[2]).double(), wanted, rtol=1e-5, atol=1e-3)
    assert (found[2] / c).item() == pytest.approx(local[2].item(), rel=1e-5)


def test_cost_is_one_minus_the_correlation_of_windows():
    draw = np.random.default_rng(0)
    light, other = draw.random((9, 11)), draw.random((9, 11))
    camera = Camera(torch.eye(4, dtype=torch.float64), 10.0, 10.0, 5.5, 4.5, 11, 9)
    here, there = (PosedImage(camera, torch.from_numpy(values).float()[None]) for values in (light, other))
    volume = cost_volume(here, [there], torch.tensor([1.0, 2.0]), 3, 0.5)
    for y, x in ((1, 1), (4, 6), (7, 9)):
        a, b = (values[y - 1 : y + 2, x - 1 : x + 2].ravel() for values in (light, other))
        wanted = min(1 - np.corrcoef(a, b)[0, 1], 1)
        assert volume[:, y, x].tolist() == pytest.approx([wanted] * 2, abs=2e-3)  # no parallax: the same on each plane


def test_the_best_part_of_the_neighbours_counts():
    draw = torch.Generator().manual_seed(0)
    camera = Camera(torch.eye(4, dtype=torch.float64), 10.0, 10.0, 8.0, 8.0, 16, 16)
    here = PosedImage(camera, torch.rand(3, 16, 16, generator=draw))
    occluded = [PosedImage(camera, torch.rand(3, 16, 16, generator=draw)) for _ in range(2)]
    planes = torch.ones(3)
    assert cost_volume(here, [occluded[0], here, occluded[1], here], planes, 5, 0.5).amax() < 0.05
    assert cost_volume(here, [occluded[0], here, occluded[1], here], planes, 5, 1.0).mean() > 0.3


def slow_path(costs: np.ndarray, jumps: np.ndarray, step: float) -> np.ndarray:
    """(X, D) costs of the best path along one line, by loops."""
    result = costs.copy()
    for x in range(1, len(costs)):
        before = result[x - 1]
        for d in range(costs.shape[1]):
            ways = [
                before[e] + (0 if e == d else step if abs(e - d) == 1 else jumps[x - 1]) for e in range(len(before))
            ]
            result[x, d] = costs[x, d] + min(ways) - before.min()
    return result


def test_scanlines_are_the_best_paths():
    draw = np.random.default_rng(1)
    volume, light = draw.random((6, 4, 5)), draw.random((4, 5)) * 0.2
    wanted = np.zeros_like(volume)
    for axis in (0, 1):
        lines, shades = (volume.transpose(1 + axis, 2 - axis, 0), np.moveaxis(light, axis, 0))
        for turn in (slice(None), slice(None, None, -1)):
            for i in range(lines.shape[1]):
                jumps = np.maximum(0.5 / (1 + np.abs(np.diff(shades[turn, i])) / 0.04), 0.1)
                path = slow_path(lines[turn, i], jumps, 0.1)[turn]
                wanted[:, :, i] += path.T if axis == 0 else 0
                if axis == 1:
                    wanted[:, i, :] += path.T
    found = smooth_costs(torch.from_numpy(volume), torch.from_numpy(light), 0.1, 0.5)
    # columns are lines of axis 0, rows those of axis 1
    np.testing.assert_allclose(found.numpy() * 4, wanted, rtol=1e-6)


def test_parabolas_find_the_minimum_between_planes():
    planes = torch.arange(7.0)
    centres = torch.tensor([[2.3, 3.0], [4.45, 5.8]])
    plane, position = best_planes((planes[:, None, None] - centres) ** 2)
    torch.testing.assert_close(position[0], centres[0])
    assert plane.tolist() == [[2, 3], [4, 6]] and position[1, 0].item() == pytest.approx(4.45, abs=1e-4)
    assert position[1, 1] == 6  # at the end of the range, there is no parabola


def test_maps_of_one_surface_agree_and_others_do_not(farm):
    scene, _, truth = farm
    cameras = [scene.train[at].camera for at in (6, 7, 11)]
    maps = [1 / truth.exact[scene.train[at].name].depth.float() for at in (6, 7, 11)]
    count, shown, fused = agreement(cameras[0], maps[0], [(cameras[1], maps[1]), (cameras[2], 1.2 * maps[2])], 0.01)
    assert (count == 1).float().mean() > 0.4 and (count == 2).float().mean() < 0.02
    assert ((fused / maps[0] - 1).abs() < 0.01).all()
    wrong = maps[0].clone()
    wrong[50:60, 60:80] *= 1.1
    count, _, _ = agreement(cameras[0], wrong, [(cameras[1], maps[1])], 0.01)
    assert not count[50:60, 60:80].any()


@needs_native
def test_maps_agree_as_in_torch(farm):
    """The compiled part and torch, also where maps have holes, no overlap, or another size."""
    scene, _, truth = farm
    draw = torch.Generator().manual_seed(3)
    cameras = [view.camera for view in scene.train[:6]]
    maps = [1 / truth.exact[view.name].depth.float() for view in scene.train[:6]]
    maps = [each * (1 + 0.01 * torch.randn(each.shape, generator=draw)) for each in maps]
    for each in maps:
        each[torch.rand(each.shape, generator=draw) < 0.2] = 0
    cameras[1] = cameras[1].resized(57, 41)
    maps[1] = torch.nn.functional.interpolate(maps[1][None, None], (41, 57), mode="nearest-exact")[0, 0]
    others = list(zip(cameras[1:], maps[1:], strict=True))
    native, plain = (how(cameras[0], maps[0], others, 0.01) for how in (agreement, agreement_in_torch))
    assert native.agreeing.max() >= 3 and native.agreeing.dtype == plain.agreeing.dtype
    # Positions are rounded differently, and so may fall on the pixel beside.
    same = (native.agreeing == plain.agreeing) & (native.shown == plain.shown)
    assert same.float().mean() > 0.999
    torch.testing.assert_close(native.fused[same], plain.fused[same], rtol=1e-5, atol=0)
    alone = agreement(cameras[0], maps[0], [], 0.01)
    assert not alone.shown.any() and torch.equal(alone.fused, maps[0])


def test_trust_asks_for_two_maps_at_least_and_for_no_more_than_show_the_place():
    count = torch.tensor([0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 4.0])
    shown = torch.tensor([0.0, 1.0, 2.0, 2.0, 5.0, 5.0, 4.0])
    wanted = torch.tensor([0, 1 / 2, 1 / 2, 1, 2 / 3, 1, 1])
    torch.testing.assert_close(DepthConsistency(count, shown, count).trust(3), wanted)


def test_edges_are_told_from_slopes():
    rows, columns = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    slope = 1 + 0.05 * columns + 0.02 * rows
    assert not at_edge(slope, 2, 0.15).any()
    step = torch.where(columns < 8, slope + 1, slope)
    assert at_edge(step, 2, 0.1).nonzero()[:, 1].unique().tolist() == [6, 7]  # the nearer side


def test_neighbours_share_points_at_a_good_angle_and_surround(farm):
    scene, observations, _ = farm
    chosen = neighbours(scene.train, observations, 4, 15)
    for at, near in enumerate(chosen):
        assert len(near) == len(set(near)) == 4 and at not in near
    away = np.stack([(scene.train[o].camera.centre - scene.train[5].camera.centre).numpy() for o in chosen[5]])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    assert (away @ away.T).min() < -0.5  # on both sides
    assert neighbours(scene.train, replace(observations, seen={}), 4, 15) == [[]] * len(scene.train)


def test_settings_that_make_no_sense_are_refused():
    for setting in (
        {"window": 4},
        {"neighbours": 0},
        {"visible": 0},
        {"tolerance": 0},
        {"step_cost": 2.0},
        {"edge": 1},
    ):
        with pytest.raises(BadInput):
            PlaneSweep(**setting)


def test_views_without_points_have_no_depth(farm, tmp_path):
    scene, observations, _ = farm
    name = scene.train[2].name
    seen = {n: replace(s, points=s.points[:5], at=s.at[:5]) if n == name else s for n, s in observations.seen.items()}
    given = DepthInput(scene.train, replace(observations, seen=seen), CPU, tmp_path)
    (estimate,) = PlaneSweep(longest=40).estimate(given, [2])
    assert estimate.inverse is None and estimate.confidence is None
