"""PatchMatch on a scene of which every depth is known, and its kernel against plain loops in float64."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from needs import needs_native
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.depth import patch_match
from surfkit.depth.base import DepthInput, KnownSurface, KnownSurfaces
from surfkit.depth.native_patch_match import GreyImage, MatchingSettings, Planes, improve, pattern, way
from surfkit.depth.neighbours import in_turn, neighbours
from surfkit.depth.patch_match import PatchMatch, PatchMatchWorkspace
from surfkit.depth.photo_light import stretched
from surfkit.depth.plane_map import PlaneMap, load_map, save_map
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.raster.native import module
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.scene.srgb import from_linear, linear
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = needs_native
CPU = torch.device("cpu")
STILL = MatchingSettings(0.1, 10, 1e-9, 0, 0, 0, 30, 2.5, samples=32, best=1, window=5, survey=True)
"""No plane is worth trying: they differ by too few pixels."""


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """An aerial grid over the box and the ball: scene, observations and truth."""
    folder = tmp_path_factory.mktemp("farm")
    truth = photograph(Flight(kind="grid", views=20, width=120, height=90, points=600, test_every=0))
    write_colmap(folder, truth, tracks=True)
    data = Data(folder, test_every=0)
    scene = read(data)
    return scene, observations(data, scene), truth


@pytest.fixture(scope="module")
def estimates(farm, tmp_path_factory):
    """Of two views."""
    scene, tracks, _ = farm
    given = DepthInput(scene.train, tracks, CPU, tmp_path_factory.mktemp("work"))
    return {estimate.at: estimate for estimate in PatchMatch(coarsest=60).estimate(given, [7, 12])}


def test_depth_and_normals_are_those_of_the_scene_where_they_are_trusted(farm, estimates):
    scene, _, truth = farm
    for at, estimate in estimates.items():
        exact = truth.exact[scene.train[at].name]
        depth = exact.depth.float()
        trusted = (estimate.confidence > 0.5) & (depth > 0)
        error = (1 / (estimate.inverse * depth) - 1).abs()[trusted]
        assert trusted.float().mean() > 0.35
        assert error.median() < 0.009 and (error < 0.02).float().mean() > 0.82  # a pixel of parallax is 0.026
        cosine = (estimate.normal * exact.normal.float()).sum(0)[trusted]
        assert cosine.median() > 0.8
        torch.testing.assert_close(estimate.normal.norm(dim=0), torch.ones_like(depth))


def test_what_is_not_trusted_is_worse(farm, estimates):
    scene, _, truth = farm
    wrong = {True: [], False: []}
    for at, estimate in estimates.items():
        depth = truth.exact[scene.train[at].name].depth.float()
        there, trusted = depth > 0, estimate.confidence > 0.5
        error = (1 / (estimate.inverse * depth) - 1).abs()
        for which in wrong:
            wrong[which].append(error[there & (trusted == which)] > 0.02)
    share = {which: float(torch.cat(parts).float().mean()) for which, parts in wrong.items()}
    assert share[False] > 1.7 * share[True] > 0


def in_other_light(view: View, light: float, corner: float, folder: Path) -> View:
    """The view with a photograph of so much light, and so much of that in its corners."""
    with Image.open(view.path) as photo:
        color = linear(np.asarray(photo.convert("RGB")) / 255)
    height, width = color.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    square = ((x - view.camera.cx) ** 2 + (y - view.camera.cy) ** 2) / ((width**2 + height**2) / 4)
    color *= light * ((1 + (corner**-0.5 - 1) * square) ** -2)[..., None]
    path = folder / view.path.name
    Image.fromarray(np.rint(255 * from_linear(color)).astype(np.uint8)).save(path.with_suffix(".png"))
    return replace(view, path=path.with_suffix(".png"))


def test_light_of_the_photographs_hardly_matters(farm, tmp_path):
    """Every other one has a quarter of the light, and all have corners of half of it."""
    scene, tracks, truth = farm
    dark = [in_other_light(view, 0.25 if at % 2 else 1, 0.5, tmp_path) for at, view in enumerate(scene.train)]
    right = []
    for number, views in enumerate((scene.train, dark)):
        given = DepthInput(views, tracks, CPU, tmp_path / str(number))
        errors = []
        for estimate in PatchMatch(coarsest=60).estimate(given, [5, 6, 7, 12]):
            depth = truth.exact[scene.train[estimate.at].name].depth.float()
            errors.append((1 / (estimate.inverse * depth) - 1).abs()[depth > 0])
        right.append(float((torch.cat(errors) < 0.02).float().mean()))
    assert right[0] > 0.8 and right[1] > right[0] - 0.04  # as they were taken, 0.16 less


def test_photographs_are_stretched_to_white():
    grey = torch.linspace(0, 100, 1001)[None]
    found = stretched(grey)
    wanted = (grey * 255 / 99.5).clamp(max=255)
    assert (found - wanted).abs().max() <= 0.5 + 1e-3 and (found == 255).float().mean() < 0.01
    assert stretched(grey / 100).max() == 4 and stretched(0 * grey).max() == 0, "noise stays dark"


def two_pictures(seed: int) -> tuple[GreyImage, GreyImage]:
    """Of noise, from two places, with lenses of their own."""
    draw = np.random.default_rng(seed)
    pose = torch.eye(4, dtype=torch.float64)
    tilted = torch.eye(3, dtype=torch.float64) + 0.05 * torch.from_numpy(draw.normal(size=(3, 3)))
    pose[:3, :3] = torch.linalg.qr(tilted)[0]
    pose[:3, :3] *= torch.sign(torch.diagonal(pose[:3, :3]))[:, None]
    pose[:3, 3] = torch.tensor([0.4, -0.2, 0.1])
    cameras = (
        Camera(torch.eye(4, dtype=torch.float64), 30.0, 32.0, 15.5, 11.0, 32, 24),
        Camera(pose, 34.0, 33.0, 18.0, 15.0, 38, 28),
    )
    return tuple(GreyImage(c, draw.integers(0, 256, (c.height, c.width)).astype(np.uint8)) for c in cameras)


def slow_cost(
    here: GreyImage, there: GreyImage, x: int, y: int, plane: np.ndarray, terms: MatchingSettings, gain: float = 1.0
) -> float:
    """1 - the weighted correlation of a window with its picture through a plane, and their brightness, by loops."""
    numbers = np.array(way(here.camera, there.camera))
    turn, shift = numbers[:9].reshape(3, 3), numbers[9:]
    height, width = here.value.shape
    middle = float(here.value[y, x])
    weights, ours, theirs = [], [], []
    for dx, dy, near in pattern(terms.window).T[: terms.samples].astype(float):
        if near == 0:
            continue
        value = float(here.value[int(np.clip(y + dy, 0, height - 1)), int(np.clip(x + dx, 0, width - 1))])
        at = turn @ [x + dx, y + dy, 1] + shift * (plane[0] + plane[1] * dx + plane[2] * dy)
        u = np.clip(at[0] / at[2], 0, there.value.shape[1] - 1)
        v = np.clip(at[1] / at[2], 0, there.value.shape[0] - 1)
        left, above = int(u), int(v)
        right, below = min(left + 1, there.value.shape[1] - 1), min(above + 1, there.value.shape[0] - 1)
        upper = there.value[above, left] * (1 - (u - left)) + there.value[above, right] * (u - left)
        under = there.value[below, left] * (1 - (u - left)) + there.value[below, right] * (u - left)
        weights.append(near * np.exp(-abs(value - middle) / terms.spread))
        ours.append(value)
        theirs.append(upper * (1 - (v - above)) + under * (v - above))
    w, a, b = np.array(weights) / sum(weights), np.array(ours), np.array(theirs)
    bright, seen = w @ a, gain * (w @ b)
    unlike = min(0.5, terms.brightness * abs(bright - seen) / ((bright + seen) / 2 + 50))
    a, b = a - w @ a, b - w @ b
    return float(min(max(0, 1 - (w * a) @ b / np.sqrt((w @ a**2 + 1) * (w @ b**2 + 1))) + unlike, 1))


def slow_gain(here: GreyImage, there: GreyImage, planes: np.ndarray) -> float:
    """Median ratio of grey values of every eighth pixel and what its plane shows, by loops."""
    numbers, ratios = np.array(way(here.camera, there.camera)), []
    for y in range(4, here.camera.height, 8):
        for x in range(4, here.camera.width, 8):
            at = numbers[:9].reshape(3, 3) @ [x, y, 1] + numbers[9:] * planes[y, x, 0]
            u, v = round(at[0] / at[2]), round(at[1] / at[2])
            if 0 <= u < there.camera.width and 0 <= v < there.camera.height:
                ratios.append((float(here.value[y, x]) + 1) / (float(there.value[v, u]) + 1))
    return float(np.median(ratios))


@pytest.mark.parametrize("samples", [16, 32])
def test_the_kernel_is_the_weighted_correlation_of_windows_and_their_brightness(samples):
    here, there = two_pictures(0)
    still = replace(STILL, samples=samples)
    planes = Planes.at(np.full((24, 32), 0.5, np.float32), 1)
    planes.value[..., 1], planes.value[..., 2] = 0.004, -0.006
    gain = slow_gain(here, there, planes.value)
    assert abs(gain - 1) > 0.02
    improve(here, [there], planes, still, seed=0)
    for x, y in ((16, 12), (10, 8), (20, 15), (1, 1)):
        wanted = slow_cost(here, there, x, y, planes.value[y, x].astype(float), still, gain)
        assert planes.cost[y, x] == pytest.approx(
            wanted, abs=8e-3
        )  # positions are rounded to a 64th of a pixel, in noise
    assert np.ptp(planes.cost[4:20, 4:28]) > 0.3


@pytest.mark.parametrize("window", range(3, 18, 2))
def test_the_pixels_of_a_window_lie_around_its_middle(window):
    half, every = window // 2, pattern(window)
    for samples, most_alone in ((16, 0), (32, 1)):
        used = every[:, :samples][:, every[2, :samples] > 0]
        at = {(int(x), int(y)) for x, y in used[:2].T}
        assert len(at) == used.shape[1] == min(samples, window**2)
        assert {max(abs(x), abs(y)) for x, y in at} >= {half} and {(-half, -half), (half, -half)} <= at
        alone = [(x, y) for x, y in at if (-x, -y) not in at]
        assert len(alone) <= most_alone and all(np.hypot(x, y) < 0.8 * half for x, y in alone)


@pytest.mark.parametrize("window", [5, 9, 15, 17])
def test_pictures_upside_down_match_as_well(window):
    """No window is compared off its middle: turned by 180 degrees, both pictures give the same costs."""

    def turned(grey: GreyImage) -> GreyImage:
        c, pose = grey.camera, torch.diag(torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64))
        lens = (c.fx, c.fy, c.width - c.cx, c.height - c.cy, c.width, c.height)
        return GreyImage(Camera(pose @ c.world_to_camera, *lens), np.ascontiguousarray(grey.value[::-1, ::-1]))

    pictures, found = two_pictures(3), []
    for here, there in (pictures, [turned(grey) for grey in pictures]):
        planes = Planes.at(np.full((24, 32), 0.5, np.float32), 1)
        improve(here, [there], planes, replace(STILL, window=window, samples=16, brightness=0.0), seed=0)
        found.append(planes.cost)
    inner = found[0] < 1  # the other view shows the pixel
    assert inner.mean() > 0.3
    np.testing.assert_allclose(found[1][::-1, ::-1][inner], found[0][inner], atol=0.02)  # a 64th of a pixel, in noise


@pytest.mark.parametrize("away", [(step * far, 0)[::flip] for far in (1, 3) for step in (-1, 1) for flip in (1, -1)])
def test_the_plane_of_another_pixel_is_taken(away):
    """By all kernels, whichever of the planes that are tried together is the right one."""
    value = np.random.default_rng(0).integers(0, 256, (24, 32)).astype(np.uint8)
    here = GreyImage(Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 16.0, 12.0, 32, 24), value)
    others = []
    for axis in (0, 1):  # inverse depth 0.5 moves two pixels to the right, or down
        pose = torch.eye(4, dtype=torch.float64)
        pose[axis, 3] = 2 / (30 * 0.5)
        others.append(GreyImage(replace(here.camera, world_to_camera=pose), np.roll(value, 2, axis=1 - axis)))
    x, y = 16 + away[0], 12 + away[1]
    terms = replace(STILL, parallax=4.0)
    rows, columns = np.mgrid[:24, :32]
    wrong = (1 + 0.06 * ((columns + 5 * rows) % 31)).astype(np.float32)  # no two of those tried are alike
    for kernels in module().kernels():
        planes = Planes.at(wrong, 2)
        planes.value[y, x, 0], planes.cost[y, x] = 0.5, 0
        module().use_kernels(kernels)
        try:
            improve(here, others, planes, terms, seed=0)
        finally:
            module().use_kernels(module().kernels()[0])
        assert planes.value[12, 16, 0] == 0.5 and planes.cost[12, 16] < 0.05, kernels


def test_a_plane_costs_the_soft_minimum_of_its_views():
    """Of pictures that all become brighter to the right, with more and more noise."""
    draw = np.random.default_rng(5)

    def bright(camera: Camera, noise: float) -> GreyImage:
        shown = 5 * np.arange(camera.width) + draw.normal(20, noise, (camera.height, camera.width))
        return GreyImage(camera, shown.clip(0, 255).astype(np.uint8))

    here, there = (grey.camera for grey in two_pictures(0))
    here, others = bright(here, 4), [bright(there, noise) for noise in (4, 10, 30)]
    planes = Planes.at(np.full((24, 32), 0.5, np.float32), 3)
    terms = replace(STILL, best=3, brightness=0.0)
    improve(here, others, planes, terms, seed=0)
    below = []
    for x, y in ((x, y) for x in range(8, 26, 3) for y in range(6, 20, 3)):
        costs = np.array([slow_cost(here, there, x, y, planes.value[y, x].astype(float), terms) for there in others])
        if costs.max() < 0.99:  # a view that shows nothing is left out
            wanted = -0.3 * np.log(np.exp(-costs / 0.3).mean())
            assert planes.cost[y, x] == pytest.approx(wanted, abs=6e-3)
            below.append(costs.mean() - wanted)
    assert len(below) > 5 and max(below) > 0.03


def test_repeated_texture_is_told_apart_by_its_brightness():
    """Waves on a surface that becomes brighter to the right: correlation takes each wave for any other."""
    draw = np.random.default_rng(4)
    shape, lens = (48, 64), (40.0, 40.0, 32.0, 24.0, 64, 48)

    def seen(right: float, exposure: float) -> GreyImage:
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -right
        y, x = np.mgrid[:48, :64]
        x = x + 40 * right * 0.5  # of inverse depth 0.5
        waves = np.sin(2 * np.pi * x / 8) + np.sin(2 * np.pi * y / 7)
        shown = 40 + 1.5 * x + 15 * waves + draw.normal(0, 1, shape)
        return GreyImage(Camera(pose, *lens), (exposure * shown).round().clip(0, 255).astype(np.uint8))

    def right(brightness: float, exposure: float) -> float:
        """Share of the pixels in the middle, which begin a wave off, whose planes are right after some passes."""
        others = [seen(to, exposure) for to in (0.4, -0.4)]
        planes = Planes.at(np.full(shape, 0.5, np.float32), 2)
        planes.value[12:-12, 22:-22, 0] = 1
        terms = MatchingSettings(0.1, 1.2, 16, 1, 0.015, 0, 15, brightness, samples=32, best=2, window=7, survey=False)
        for index in range(6):
            improve(seen(0, 1), others, planes, replace(terms, survey=index == 0), seed=index)
        return float((16 * np.abs(planes.value[14:-14, 24:-24, 0] - 0.5) < 1).mean())

    alike, other, blind = right(2.5, 1), right(2.5, 0.7), right(0, 1)
    assert alike > 0.9 > 0.1 > blind
    assert other > 0.9  # photographs of another exposure


def test_passes_do_not_lose_what_is_right_where_noise_is_all_that_differs():
    """A plane fainter than the noise of all pictures, found already: there is nothing to win by another one."""
    draw = np.random.default_rng(8)
    shape, lens = (48, 64), (40.0, 40.0, 32.0, 24.0, 64, 48)
    surface = draw.normal(128, 0.5, shape)

    def seen(right: float) -> GreyImage:
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -right
        shown = np.roll(surface, -round(40 * right * 0.5), 1) + draw.normal(0, 1.5, shape)
        return GreyImage(Camera(pose, *lens), shown.round().astype(np.uint8))

    planes = Planes.at(np.full(shape, 0.5, np.float32), 4)
    terms = MatchingSettings(0.1, 1, 20, 1, 0.015, 0, 15, 2.5, samples=32, best=3, window=7, survey=False)
    others = [seen(right) for right in (0.25, 0.5, -0.25, -0.5)]
    ours = seen(0)
    for index in range(8):
        improve(ours, others, planes, replace(terms, survey=index == 0), seed=index)
    pixels = 20 * np.abs(planes.value[8:-8, 12:-12, 0] - 0.5)
    assert (pixels < 0.5).mean() > 0.55


def test_maps_agree_better_after_more_rounds(farm, tmp_path):
    scene, tracks, _ = farm
    trusted = []
    for rounds in (1, 3):
        settings = PatchMatch(coarsest=60, passes=2, neighbours=4, rounds=rounds)
        given = DepthInput(scene.train, tracks, CPU, tmp_path / str(rounds))
        (estimate,) = settings.estimate(given, [9])
        trusted.append(float((estimate.confidence > 0.25).float().mean()))
    assert trusted[1] > 1.05 * trusted[0] > 0


def test_a_window_of_which_nothing_counts_matches_nothing():
    """With a narrow spread, as settings allow it, a bright pixel is compared with none of the dark ones around it."""
    here, there = two_pictures(0)
    dark = np.zeros_like(here.value)
    dark[4::9, 4::9] = 255
    here, terms = GreyImage(here.camera, dark), replace(STILL, spread=255 * 1e-4, samples=16, window=7)
    assert not (pattern(7)[:2, :16] == 0).all(0).any()
    for kernels in module().kernels():
        module().use_kernels(kernels)
        try:
            planes = Planes.at(np.full(dark.shape, 0.5, np.float32), 1)
            improve(here, [there], planes, terms, seed=0)
        finally:
            module().use_kernels(module().kernels()[0])
        assert (planes.each[4::9, 4::9] == 255).all(), kernels
        assert planes.cost.max() <= 2, kernels


def test_words_that_are_gathered_and_inserted_are_the_same(monkeypatch):
    """Pixels of the window, grey values of another picture and its depth map; one of the two is what AVX-512 uses."""
    if "avx512" not in module().kernels():
        pytest.skip("needs a processor with AVX-512")
    here, there = two_pictures(1)
    known = [torch.rand(28, 38, generator=torch.Generator().manual_seed(0)) + 0.2]
    terms, found = replace(STILL, parallax=40.0, jitter_px=1.0, consistency=0.2), {}
    for kernels in ("avx512", "avx512_insert", "avx512_gather"):
        monkeypatch.setattr(module(), "kernels_in_use", lambda kernels=kernels: kernels)
        found[kernels] = Planes.at(np.full((24, 32), 0.7, np.float32), 1)
        for seed in range(3):
            improve(here, [there], found[kernels], terms, seed, known)
    for planes in found.values():
        for name in ("value", "cost", "each"):
            np.testing.assert_array_equal(getattr(planes, name), getattr(found["avx512_insert"], name))
    assert len(np.unique(found["avx512"].value)) > 100, "planes have been improved"


def test_the_reprojection_error_counts_up_to_its_limit():
    here, there = two_pictures(1)
    plain, with_maps, with_wrong = (Planes.at(np.full((24, 32), 0.5, np.float32), 1) for _ in range(3))
    improve(here, [there], plain, STILL, seed=0)
    numbers = np.array(way(here.camera, there.camera))
    z = (numbers[:9].reshape(3, 3) @ [16, 12, 1] + 0.5 * numbers[9:])[2]
    exact = np.full(there.value.shape, 0.5 / z, np.float32)  # the depth there of this pixel
    terms = replace(STILL, consistency=0.1)
    improve(here, [there], with_maps, terms, seed=0, known=[torch.from_numpy(exact)])
    improve(here, [there], with_wrong, terms, seed=0, known=[torch.from_numpy(5 * exact)])
    assert 0 <= with_maps.cost[12, 16] - plain.cost[12, 16] < 0.1  # less than a pixel: it is rounded to one there
    assert with_wrong.cost[12, 16] - plain.cost[12, 16] == pytest.approx(0.3, abs=1e-5)


@pytest.mark.parametrize("views", [7, 16])  # some, and as many as there may be
def test_those_views_are_looked_at_that_match_best_here_and_around(views):
    """Twice as many as count; the pixel itself counts twice, each of its neighbours once."""
    here = two_pictures(0)[0]
    others = [two_pictures(seed)[1] for seed in range(1, views + 1)]
    planes = Planes.at(np.full((24, 32), 0.5, np.float32), len(others))
    planes.each[:] = np.random.default_rng(5).integers(0, 60, planes.each.shape)  # noise matches worse than that
    before = planes.each.astype(int)
    votes = 2 * before[1:-1, 1:-1] + before[:-2, 1:-1] + before[2:, 1:-1] + before[1:-1, :-2] + before[1:-1, 2:]
    improve(here, others, planes, replace(STILL, best=2, survey=False), seed=0)
    looked_at = np.zeros(votes.shape, bool)
    np.put_along_axis(looked_at, np.argsort(votes, axis=-1, kind="stable")[..., :4], True, -1)
    y, x = np.indices(votes.shape[:2])
    first = (y + x) % 2 == 0  # the others know what these have found
    np.testing.assert_array_equal((planes.each[1:-1, 1:-1] != before[1:-1, 1:-1])[first], looked_at[first])


def test_a_plane_counts_in_the_views_that_match_it_best():
    """Half of the views show something nearer in front: what lies behind is found in the others, though all pixels
    begin in front, where the first half matches better."""
    draw = np.random.default_rng(4)
    ours = draw.integers(60, 190, (40, 64)).astype(np.uint8)
    lens = (40.0, 40.0, 32.0, 20.0, 64, 40)

    def moved(right: float, inverse: float, noise: float) -> GreyImage:
        """Seen from a place to the right, all at one depth."""
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -right
        shown = np.roll(ours, -round(40 * right * inverse), 1) + draw.normal(0, noise, ours.shape)
        return GreyImage(Camera(pose, *lens), shown.clip(0, 255).astype(np.uint8))

    front, behind = 0.8, 0.4
    others = [moved(right, front, 25) for right in (0.25, 0.5, -0.25)]
    others += [moved(right, behind, 0) for right in (0.25, 0.5, -0.25)]
    planes = Planes.at(np.full(ours.shape, front, np.float32), 6)
    planes.each[..., :3], planes.each[..., 3:] = 60, 250
    planes.value[:, 30:34, 0] = behind
    terms = MatchingSettings(0.1, 2, 14, 0, 0.001, 0, 30, 2.5, samples=32, best=3, window=7, survey=False)
    for index in range(6):
        improve(GreyImage(Camera(torch.eye(4, dtype=torch.float64), *lens), ours), others, planes, terms, seed=index)
    inner = planes.value[8:-8, 16:-16, 0]
    assert (np.abs(inner - behind) < 0.02).mean() > 0.95


def test_fewer_large_pictures_are_kept_in_memory(farm, tmp_path):
    scene, tracks, _ = farm
    given, pairs = DepthInput(scene.train, tracks, CPU, tmp_path), [[1, 2, 3], *[[0]] * 19]
    assert PatchMatchWorkspace(PatchMatch(), given, pairs, []).room() == 48
    large = [replace(view, camera=view.camera.resized(4000, 3000)) for view in scene.train]
    kept = PatchMatchWorkspace(PatchMatch(longest=4000), replace(given, views=large), pairs, []).room()
    assert 5 < kept < 12 and kept * (7 + 4 * 3) * 12e6 <= 2**31
    huge = [replace(view, camera=view.camera.resized(20_000, 15_000)) for view in scene.train]
    assert PatchMatchWorkspace(PatchMatch(longest=20_000), replace(given, views=huge), pairs, []).room() == 5


@pytest.mark.parametrize("setting", ["brightness", "smoothness", "consistency"])
def test_each_cost_that_is_set_decides_about_maps(farm, tmp_path, setting):
    scene, tracks, _ = farm
    pairs = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2], *[[0]] * 16]

    def inverse(name: str, estimator: PatchMatch) -> torch.Tensor:
        (tmp_path / name).mkdir()
        given = DepthInput(scene.train, tracks, CPU, tmp_path / name)
        return PatchMatchWorkspace(estimator, given, pairs, [0]).last.map(0).inverse

    as_set = inverse("set", PatchMatch(rounds=1, passes=1))
    other = inverse("other", PatchMatch(rounds=1, passes=1, **{setting: getattr(PatchMatch(), setting) / 2}))
    assert not torch.equal(as_set, other)


def test_maps_that_nobody_needs_any_more_are_deleted(farm, tmp_path):
    """While twenty views are estimated one after the other, and with the same result."""
    scene, tracks, _ = farm
    settings = PatchMatch(coarsest=60, passes=1, neighbours=2, best=1, longest=60)
    found, most, pairs = {}, 0, neighbours(scene.train, tracks, 2, settings.angle)
    given = DepthInput(scene.train, tracks, CPU, tmp_path / "all")
    left = in_turn(pairs, range(20))
    for estimate in settings.estimate(given, range(20)):
        assert estimate.at == left[0]
        there = {int(path.stem) for path in (given.work / "comparing-depth-maps-round-2").glob("*.planes")}
        assert there >= {at for at in left for at in (at, *pairs[at])} & found.keys()
        found[left.pop(0)] = estimate
        most = max(most, len(list(given.work.rglob("*.planes"))))
    assert 5 < most < 30 and not [path for path in given.work.rglob("*") if path.is_file()]
    alone = DepthInput(scene.train, tracks, CPU, tmp_path / "alone")
    (again,) = settings.estimate(alone, [9])
    assert torch.equal(again.inverse, found[9].inverse) and torch.equal(again.confidence, found[9].confidence)


def test_photographs_are_estimated_beside_those_that_they_are_compared_with():
    """However they are named: maps are kept until the last that is compared with them is done."""
    row = np.random.default_rng(0).permutation(40).tolist()  # of a flight along a line
    place = {at: index for index, at in enumerate(row)}
    pairs = [[row[i] for i in (place[at] - 1, place[at] + 1) if 0 <= i < 40] for at in range(40)]
    order = in_turn(pairs, range(40))
    assert order in (row, row[::-1])
    assert in_turn(pairs, [3, 9]) == [at for at in order if at in (3, 9)]
    assert sorted(in_turn([[], [2], []], range(3))) == [0, 1, 2]


def test_photographs_are_made_smaller_once(farm, tmp_path, monkeypatch):
    """Also where no more of them stay in memory than one is compared with, at any size."""
    scene, tracks, _ = farm
    made, halved = [], PatchMatchWorkspace.halved
    monkeypatch.setattr(
        PatchMatchWorkspace, "halved", lambda self, level, at: made.append((level, at)) or halved(self, level, at)
    )
    monkeypatch.setattr(patch_match, "MAX_CACHED_PICTURES", 1)
    views = scene.train[:6]
    settings = PatchMatch(longest=120, coarsest=32, passes=1, rounds=1, neighbours=5)
    list(settings.estimate(DepthInput(views, tracks, CPU, tmp_path), range(6)))
    assert len({level for level, _ in made}) == 2 and len(made) == len(set(made)) == 2 * 6


def test_the_number_of_threads_changes_nothing(farm, tmp_path):
    scene, tracks, _ = farm
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        given = DepthInput(scene.train, tracks, CPU, tmp_path / str(threads))
        (estimate,) = PatchMatch(coarsest=60, passes=1, neighbours=3).estimate(given, [3])
        found.append(estimate)
    for name in ("inverse", "confidence", "normal"):
        assert torch.equal(getattr(found[0], name), getattr(found[1], name))


def test_planes_go_on_at_another_size():
    planes = Planes.at(np.zeros((6, 8), np.float32), 2)
    y, x = np.indices((6, 8))
    planes.value[:] = np.stack([1 + 0.1 * x + 0.2 * y, np.full((6, 8), 0.1), np.full((6, 8), 0.2)], 2)
    larger = planes.resized(12, 16)
    y, x = np.indices((12, 16))
    wanted = 1 + 0.1 * ((x + 0.5) / 2 - 0.5) + 0.2 * ((y + 0.5) / 2 - 0.5)
    np.testing.assert_allclose(larger.value[..., 0], wanted, rtol=1e-5)
    np.testing.assert_allclose(larger.value[..., 1:], np.broadcast_to([0.05, 0.1], (12, 16, 2)), rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (3, 3)])
def test_pictures_of_a_few_pixels_are_no_trouble(shape):
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, shape[1] / 2, shape[0] / 2, shape[1], shape[0])
    grey = GreyImage(camera, np.full(shape, 128, np.uint8))  # and without texture
    planes = Planes.at(np.full(shape, 0.5, np.float32), 2)
    terms = MatchingSettings(0.1, 2, 10, 1, 0.01, 0, 30, 2.5, samples=16, best=1, window=7, survey=True)
    improve(grey, [grey, grey], planes, terms, seed=1)
    assert np.isfinite(planes.value).all() and np.isfinite(planes.cost).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (3, 4)])
def test_maps_of_a_few_pixels_are_read_as_they_were_written(shape, tmp_path):
    draw = np.random.default_rng(6)
    made = PlaneMap(draw.random((*shape, 3), np.float32), draw.integers(0, 256, (*shape, 5)).astype(np.uint8), 7.5)
    save_map(tmp_path / "a", made)
    read = load_map(tmp_path / "a")
    np.testing.assert_array_equal(read.inverse, made.value[..., 0])
    np.testing.assert_array_equal(read.value, made.value)
    np.testing.assert_array_equal(read.each, made.each)
    save_map(tmp_path / "b", None)
    assert load_map(tmp_path / "b") is None
    assert read.parallax == 7.5 and read.normals(Camera(torch.eye(4), 1, 1, 0, 0, *shape[::-1])).shape == (3, *shape)


@pytest.mark.parametrize(
    "estimator",
    [PlaneSweep(longest=64, neighbours=3), PatchMatch(longest=64, coarsest=60, neighbours=4, rounds=1)],
)
def test_small_photographs_among_larger_ones_do_not_refuse_the_window(farm, tmp_path, estimator):
    """They are smaller than the window, down to a single pixel; maps are made of all."""
    scene, tracks, _ = farm
    sizes = {0: (40, 4), 1: (1, 90), 2: (1, 1)}
    views = [replace(v, camera=v.camera.resized(*sizes.get(at, (120, 90)))) for at, v in enumerate(scene.train)]
    estimator.refuse_unfit(views)
    for estimate in estimator.estimate(DepthInput(views, tracks, CPU, tmp_path), [0, 1, 2, 7]):
        camera = views[estimate.at].camera.fitted(estimator.longest)
        assert estimate.inverse.shape == estimate.confidence.shape == (camera.height, camera.width)
        assert torch.isfinite(estimate.inverse).all() and torch.isfinite(estimate.confidence).all()
        assert float((estimate.confidence > 0.5).float().mean()) > 0.03 or estimate.at in sizes
    with pytest.raises(BadInput, match="view_000.png, is 40 x 4 .* 3 to 4"):
        estimator.refuse_unfit(views[:3])


def test_a_scale_is_a_share_of_each_photograph_and_the_longest_side_still_counts(farm, tmp_path):
    scene, tracks, _ = farm
    few = {"coarsest": 32, "passes": 1, "rounds": 1, "neighbours": 3}
    found = []
    for name, settings in {"scale": {"scale": 2.5}, "longest": {"longest": 48}}.items():
        given = DepthInput(scene.train, tracks, CPU, tmp_path / name)
        found += PatchMatch(**few, **settings).estimate(given, [3])
    assert found[0].inverse.shape == (36, 48)  # of 120 x 90
    assert torch.equal(found[0].inverse, found[1].inverse) and torch.equal(found[0].confidence, found[1].confidence)

    def sides(camera: Camera) -> tuple[int, int]:
        return camera.width, camera.height

    whole = scene.train[0].camera
    assert sides(PatchMatch(scale=2).of_map(whole.resized(4001, 3000))) == (1600, 1200)
    assert sides(PatchMatch(scale=4).of_map(whole.resized(4001, 3000))) == (1000, 750)
    assert sides(PatchMatch(scale=1000).of_map(whole)) == (1, 1)
    with pytest.raises(BadInput, match="window is 7, .*view_0.* 7 x 5"):
        PatchMatch(scale=18).refuse_unfit(scene.train)


def test_views_without_points_have_no_depth(farm, tmp_path):
    scene, tracks, _ = farm
    name = scene.train[2].name
    seen = {n: replace(s, points=s.points[:5], at=s.at[:5]) if n == name else s for n, s in tracks.seen.items()}
    given = DepthInput(scene.train, replace(tracks, seen=seen), CPU, tmp_path)
    (estimate,) = PatchMatch(longest=40, coarsest=32, neighbours=2, best=1).estimate(given, [2])
    assert estimate.inverse is None and estimate.confidence is None


def test_photographs_from_one_place_have_no_depth(farm, tmp_path):
    scene, tracks, _ = farm
    views = [replace(view, camera=scene.train[7].camera) for view in scene.train]
    (estimate,) = PatchMatch(longest=40, coarsest=32, neighbours=2, best=1).estimate(
        DepthInput(views, tracks, CPU, tmp_path), [7]
    )
    assert estimate.inverse is None


def test_settings_that_make_no_sense_are_refused():
    for setting in (
        {"window": 4},
        {"window": 19},
        {"neighbours": 17},
        {"best": 17},
        {"passes": 0},
        {"rounds": 0},
        {"spread": 0},
        {"tolerance_px": 0},
        {"edge": 1},
        {"longest": 8},
        {"scale": 0.5},
        {"scale": float("nan")},
    ):
        with pytest.raises(BadInput):
            PatchMatch(**setting)


def test_planes_lie_in_a_surface_that_is_known():
    """A slanted plane, but where it is not known, out of range, seen at a grazing angle, or without a normal."""
    camera = Camera(torch.eye(4, dtype=torch.float64), 50.0, 40.0, 8.0, 6.0, 16, 12)
    rays, away = camera.rays().double(), torch.tensor([0.3, -0.2, -1.0], dtype=torch.float64)
    normal = away / away.norm()
    inverse = (normal[:, None, None] * rays).sum(0) / -2.0  # the plane of all X with normal . X = -2
    wanted = inverse.numpy()
    normals = normal[:, None, None].repeat(1, 12, 16)
    inverse[0], inverse[1] = 0, 5
    normals[:, 2] = torch.linalg.cross(rays[:, 2].T, torch.tensor([1.0, 0, 0], dtype=torch.float64).expand(16, 3)).T
    normals[:, 2] /= normals[:, 2].norm(dim=0)
    normals[:, 3] = 0
    planes = Planes.at(np.full((12, 16), 0.25, np.float32), 2)
    planes.lie_in(KnownSurface(inverse.float(), normals.float()), camera, (0.1, 1.0))
    np.testing.assert_allclose(planes.value[2:, :, 0], wanted[2:], rtol=1e-5)
    np.testing.assert_allclose(planes.value[4:, :-1, 1], np.diff(wanted, axis=1)[4:], rtol=1e-3)
    np.testing.assert_allclose(planes.value[4:-1, :, 2], np.diff(wanted, axis=0)[4:], rtol=1e-3)
    assert (planes.value[:2] == [0.25, 0, 0]).all() and not planes.value[2:4, :, 1:].any()
    found = PlaneMap(planes.value[4:], planes.each[4:], 1.0)
    below = replace(camera, cy=camera.cy - 4, height=8)
    torch.testing.assert_close(found.normals(below), normals[:, 4:].float(), atol=1e-4, rtol=0)


def test_an_estimate_goes_on_from_what_is_known(farm, tmp_path):
    """Exact surfaces stay, nearer to the truth than what is found without them; wrong and missing ones are mended."""
    scene, tracks, truth = farm
    exact = [truth.exact[view.name] for view in scene.train]

    def known(square):
        def see(at, camera):
            assert (camera.width, camera.height) == (120, 90), "at full size"
            inverse = torch.where(exact[at].depth > 0, 1 / exact[at].depth, 0).float()
            inverse[30:42, 40:60] *= square
            return KnownSurface(inverse, exact[at].normal.float())

        return KnownSurfaces(see, str(square))

    wrong = []
    for number, given in enumerate((None, known(1.0), known(1.2), known(0.0))):
        given = DepthInput(scene.train, tracks, CPU, tmp_path / str(number), known=given)
        (found,) = PatchMatch(coarsest=32, rounds=1).estimate(given, [7])
        depth = exact[7].depth.float()
        error = torch.where(depth > 0, (1 / (found.inverse * depth) - 1).abs(), 0)
        wrong.append([float((part > 0.02).float().mean()) for part in (error, error[30:42, 40:60])])
    plain, exactly, *others = wrong
    assert exactly[0] < 0.2 * plain[0]
    for found in others:
        assert found[0] < 0.5 * plain[0] and found[1] < 0.25, "neighbours and photographs decide"
