"""Splats that are chosen for a camera, from levels of detail or by lot, and when a browser gets them."""

import math
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Browser, wait_until
from needs import needs, needs_native

from surfkit.apps.view.browser_camera import REST_S, TICK_S, WORLD, BrowserCamera, CameraFollower
from surfkit.apps.view.lod_selection import LodCamera, LodSplats, SampledSplats, in_places, reach_of, visibility
from surfkit.apps.view.server import Address, served
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import ViewerScene
from surfkit.compress.levels import MergedLevels
from surfkit.compress.levels.base import LodInput
from surfkit.io.splats.splat_table import SplatTable
from surfkit.primitives.model import SplatModel, primitive_of
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

NEAR = 0.01


def camera(at, to, size=(80, 60)):
    """Looks from a place to another, z up."""
    ahead = torch.tensor(to, dtype=torch.float64) - torch.tensor(at, dtype=torch.float64)
    z = ahead / ahead.norm()
    x = torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    x = x / x.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(at, dtype=torch.float64)
    return Camera(pose, 60.0, 60.0, size[0] / 2, size[1] / 2, *size)


def field(count=20_000, side=4.0):
    """Surfels on the ground."""
    draw = torch.Generator().manual_seed(0)
    means = torch.cat([side * (2 * torch.rand(count, 2, generator=draw) - 1), torch.zeros(count, 1)], 1)
    return SplatTable(
        "surfel",
        means,
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(),
        torch.randn(count, 2, generator=draw) * 0.4 + math.log(0.7 * 2 * side / count**0.5),
        2 + torch.randn(count, generator=draw),
        torch.randn(count, 3, generator=draw),
        torch.zeros(count, 0, 3),
    )


LOW = camera((0.0, -3.5, 0.4), (0.0, -2.0, 0.0))


def in_image(lens, means, near=NEAR):
    found = lens.project(means).numpy()
    x, y, z = found.T
    return (x >= 0) & (x <= lens.width) & (y >= 0) & (y <= lens.height) & (z > near)


def test_what_an_eye_sees_is_what_projects_into_the_image():
    draw = torch.Generator().manual_seed(1)
    means = 3 * torch.randn(4000, 3, generator=draw)
    eye = LodCamera(replace(LOW, cx=30.0, cy=40.0), 0.5)
    points = torch.full((4000,), 1e-6)
    assert (eye.sees(means, points)[0].numpy() == in_image(eye.camera, means, 0.5)).mean() > 0.999
    reach = 0.5 * torch.rand(4000, generator=draw)
    seen, distance = eye.sees(means, reach)
    around = torch.nn.functional.normalize(torch.randn(4000, 200, 3, generator=draw), dim=2)
    places = means[:, None] + reach[:, None, None] * around
    touches = in_image(eye.camera, places.reshape(-1, 3), 0.5).reshape(4000, 200).any(1)
    assert touches.sum() > 300 and seen.numpy()[touches].all(), "none that reaches into the image is left out"
    assert seen.float().mean() < 0.5
    exact = (means.double() - eye.camera.centre).norm(dim=1)
    assert np.allclose(distance, torch.maximum(exact, reach.double()), atol=1e-5)


def test_a_lot_keeps_what_the_parts_of_the_image_show():
    table, eye = field(), LodCamera(LOW, NEAR)
    chosen = SampledSplats(table).choose(1000, eye)
    assert len(chosen) == len(chosen.table) == len(np.unique(chosen.ids)) == 1000
    distances = (table.means.double() - LOW.centre).norm(dim=1).numpy()
    seen = in_image(LOW, table.means)
    assert seen.sum() > 2000, "more than the budget"

    def shown(some, rows):
        area = some.log_scales.double().exp().prod(1).numpy() * torch.sigmoid(some.opacity_logits.double()).numpy()
        return area / distances[rows] ** 2

    exact, drawn = shown(table, np.arange(len(table))), shown(chosen.table, chosen.ids)
    for part in (seen, seen & (distances < 2), seen & (distances > 2), seen & (table.means[:, 0].numpy() < 0)):
        assert drawn[part[chosen.ids]].sum() == pytest.approx(exact[part].sum(), rel=0.1)
    kept = np.isin(np.arange(len(table)), chosen.ids)
    close = seen & (distances < 0.8)
    assert kept[close].mean() > 2 * kept[seen & (distances > 3)].mean() > 0
    raised = (chosen.table.log_scales - table.log_scales[chosen.ids]).numpy()
    assert (raised >= 0).all() and np.allclose(raised[:, 0], raised[:, 1])
    beside = ~eye.widened().sees(table.means, reach_of(table))[0].numpy()[chosen.ids]
    assert 0 < beside.sum() < 150 and not raised[beside].any(), "few beside the image, and none is enlarged into it"
    step = replace(LOW, world_to_camera=LOW.world_to_camera.clone())
    step.world_to_camera[0, 3] += 0.02
    assert np.isin(SampledSplats(table).choose(1000, LodCamera(step, NEAR)).ids, chosen.ids).mean() > 0.9, (
        "most are kept"
    )


def test_a_lot_for_no_camera():
    table = field(5000)
    chosen = SampledSplats(table).choose(500)
    total = visibility(table).double().exp().sum()
    assert float(visibility(chosen.table).double().exp().sum()) == pytest.approx(float(total), rel=0.05)
    for all_of_it in (SampledSplats(table).choose(5000), SampledSplats(table).choose(10**9, LodCamera(LOW, NEAR))):
        assert all_of_it.table.means is table.means and np.array_equal(all_of_it.ids, np.arange(5000))


@pytest.fixture(scope="module")
def built():
    """A model, its levels of detail, and what draws it."""
    table = field(4000)
    primitive = primitive_of(table)
    model = SplatModel(primitive, primitive.from_table(table, torch.Generator()), 0)
    above = View("above", camera((0.0, -0.01, 5.0), (0.0, 0.0, 0.0), (200, 200)), None)
    rasterizer = select("cpu")[0]
    given = LodInput(model, [above], rasterizer, Frame(np.zeros(3), 1.0), 0, Path("levels"))
    return table, MergedLevels(tile_points=125, steps=0).build(given), rasterizer


def test_levels_are_fine_near_the_camera(built):
    _, tree, _ = built
    for budget in (800, 1500):
        chosen = LodSplats(tree).choose(budget, LodCamera(LOW, NEAR))
        assert budget / 3 < len(chosen) <= budget and len(np.unique(chosen.ids)) == len(chosen) == len(chosen.table)
        starts = np.cumsum([0, *map(len, tree.levels)])
        level = np.searchsorted(starts, chosen.ids, side="right") - 1
        for number in np.unique(level):
            rows = chosen.ids[level == number] - starts[number]
            assert torch.equal(chosen.table.means[level == number], tree.levels[number].params["means"][rows])
        seen = in_image(LOW, chosen.table.means)
        distance = np.linalg.norm(chosen.table.means.numpy() - LOW.centre.numpy(), axis=1)
        near, far = level[seen & (distance < 1)], level[seen & (distance > 3)]
        assert near.mean() < far.mean() - 0.7, "finer near it"
    assert LodSplats(tree).choose(5, LodCamera(LOW, NEAR)) is None
    away = LodSplats(tree).choose(1000, LodCamera(camera((0.0, -5.0, 0.4), (0.0, -9.0, 0.4)), NEAR))
    assert 0 < len(away) <= 1000, "something beside the image, of which nothing is seen"


def test_what_is_in_the_image_is_all_there_where_the_budget_allows(built):
    table, tree, _ = built
    low = camera((0.0, 0.0, 0.4), (0.0, 0.01, 0.0))
    seen = in_image(low, table.means)
    assert 0 < seen.sum() < 200
    chosen = LodSplats(tree).choose(900, LodCamera(low, NEAR))
    first = chosen.ids[chosen.ids < len(table)]
    assert np.isin(seen.nonzero()[0], tree.order[first]).all()
    assert not in_image(low, chosen.table.means[chosen.ids >= len(table)]).any(), "and nothing that stands for it"


@needs_native
def test_it_looks_more_like_the_model_than_one_level_for_all(built):
    table, tree, rasterizer = built
    subject = ViewerScene(Path("s"), Frame(np.zeros(3), 1.0), np.array([0.0, 0, 1]), table, levels=tree)
    without = replace(subject, levels=None)

    def drawn(found):
        primitive = primitive_of(found)
        splats = SplatModel(primitive, primitive.from_table(found, torch.Generator()), 0).splats.detached()
        return rasterizer.render(splats, LOW, NEAR, False, False).maps.color

    exact = drawn(table)

    def psnr(found):
        return -10 * math.log10(float(((drawn(found) - exact) ** 2).mean()))

    budget, eye = 800, LodCamera(LOW, NEAR)
    assert psnr(SharedCache(subject).for_eye(budget, eye)[0].table) > psnr(SharedCache(subject).within(budget)[0]) + 3
    assert psnr(SharedCache(without).for_eye(budget, eye)[0].table) > psnr(SharedCache(without).within(budget)[0]) + 2


def test_splats_stay_in_their_places():
    draw = np.random.default_rng(0)
    for size, had, wants in ((100, 80, 100), (100, 100, 60), (7, 0, 7), (5, 5, 0)):
        before = np.full(size, -1)
        before[draw.permutation(size)[:had]] = draw.permutation(300)[:had]
        wanted = draw.permutation(300)[:wants]
        places = in_places(before, wanted)
        assert len(np.unique(places)) == wants and ((places >= 0) & (places < size)).all()
        there = np.isin(wanted, before)
        assert np.array_equal(before[places[there]], wanted[there])


def new_threads(before):
    """That follow cameras and were not among the threads before: those of other tests may take a while to end."""
    return [each for each in threading.enumerate() if each.name == "follow a camera" and each not in before]


def test_following_a_camera():
    told, inside, together, before = [], [], [], threading.enumerate()

    def action(moves):
        inside.append(1)
        together.append(len(inside))
        time.sleep(0.02)
        inside.pop()
        told.append(moves)

    following = CameraFollower(action)
    time.sleep(REST_S + 0.1)
    assert not told, "a camera that does not move is left alone"
    begun = last = time.monotonic()
    rests = 1
    while told.count(True) < 4:
        now = time.monotonic()
        following.moved()
        rests += time.monotonic() - last >= REST_S  # this thread was held up, so that the camera has rested
        assert len(told) <= rests + (time.monotonic() - begun) / TICK_S
        last = now
        time.sleep(0.01)
    wait_until(lambda: told[-1] is False)
    time.sleep(2 * REST_S + 0.3)
    assert told[0] is True and told.count(False) <= rests and max(together) == 1
    (thread,) = new_threads(before)
    following.stop()
    thread.join()
    assert not thread.is_alive()
    count = len(told)
    following.moved()
    time.sleep(0.1)
    assert len(told) == count


def test_far_and_the_same():
    here = BrowserCamera(LodCamera(LOW, NEAR), 1.0)
    assert here.same_as(BrowserCamera(LodCamera(replace(LOW, world_to_camera=LOW.world_to_camera.clone()), NEAR), 2.0))
    assert not here.same_as(BrowserCamera(LodCamera(replace(LOW, fx=61.0, fy=61.0), NEAR), 1.0))
    for gone, far in ((0.2, False), (0.3, True)):
        moved = BrowserCamera(LodCamera(camera((gone, -3.5, 0.4), (gone, -2.0, 0.0)), NEAR), 1.0)
        assert moved.far_from(here) == far and not moved.same_as(here)
    for degrees, far in ((10, False), (20, True)):
        ahead = 1.5 * math.tan(math.radians(degrees))
        assert (
            BrowserCamera(LodCamera(camera((0.0, -3.5, 0.4), (ahead, -2.0, 0.4)), NEAR), 1.0).far_from(
                BrowserCamera(LodCamera(camera((0.0, -3.5, 0.4), (0.0, -2.0, 0.4)), NEAR), 1.0)
            )
            == far
        )


def sent(browser):
    return [row for row in browser.told if row["type"] == "GaussianSplatsMessage"]


def test_a_page_follows_its_browser(tmp_path, monkeypatch):
    needs("viser")
    subject = ViewerScene(Path("s"), Frame(np.zeros(3), 1.0), np.array([0.0, 0, 1]), field(2000))
    plain, eyes, inside, together, first = SharedCache.for_eye, [], [], [], threading.Event()
    before = threading.enumerate()

    def slow(self, budget, eye):
        inside.append(1)
        together.append(len(inside))
        eyes.append(eye)
        assert first.wait()
        time.sleep(0.15)
        inside.pop()
        return plain(self, budget, eye)

    drawn, made = SharedCache.drawn, []
    monkeypatch.setattr(SharedCache, "drawn", lambda *given: made.append(1) or drawn(*given))
    monkeypatch.setattr(SharedCache, "for_eye", slow)
    with served(Address(), "test") as found:
        show(subject, found, tmp_path, most=500)
        browser = Browser(found.url)
        browser.wait_for(lambda b: eyes)
        browser.stand(-50.0)  # while the first splats are chosen
        (client,) = found.viser.get_clients().values()
        wait_until(lambda: client.camera.position[2] == -50)
        first.set()
        browser.wait_for(lambda b: any(row.get("label") == "write path file" for row in b.gui.values()))
        browser.wait_for(lambda b: any(t.startswith("500 splats, drawn by lot") for t in b.texts()))
        at = 0.0
        while len(eyes) < 5:  # never at rest, and always far from where it was
            at += 5
            browser.stand(at)
            time.sleep(0.02)
        browser.wait_for(lambda b: float(eyes[-1].camera.centre[2]) == pytest.approx(at / WORLD))
        rested = len(eyes)
        browser.wait_for(lambda b: len(sent(b)) >= 2)
        time.sleep(3 * REST_S)
        assert max(together) == 1 and len(eyes) == rested, "one at a time, and none at rest"
        assert len(made) < len(eyes), "the first was abandoned"
        assert not any(row["type"] == "RemoveSceneNodeMessage" and row["name"] == "/splats" for row in browser.told)
        browser.set("finer where I am", False)
        browser.wait_for(lambda b: any(t.startswith("500") and "fine where" not in t for t in b.texts()))
        browser.stand(-100.0)
        time.sleep(3 * REST_S)
        browser.set("most splats", 2000)
        browser.wait_for(lambda b: any("all 2,000 splats" in t for t in b.texts()))
        assert len(eyes) == rested, "the same splats for all places"
        browser.close()
        wait_until(lambda: not new_threads(before))  # the thread ends with its browser
