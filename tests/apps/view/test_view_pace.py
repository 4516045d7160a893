"""How much slow browsers are sent: the limit against browsers that are played, and the requests of the script."""

import math
import re
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Browser, cookie, get
from needs import needs

from surfkit.apps.view.draw_limits import (
    INITIAL_LIMITS,
    LATE_S,
    MAX_UNASKED_ITEMS,
    MIN_LIMITS,
    REST_FACTOR,
    DrawLimit,
    numbers,
)
from surfkit.apps.view.lod_selection import LodCamera, SampledPoints
from surfkit.apps.view.server import Address, served
from surfkit.apps.view.shared_cache import MAX_POINT_ENLARGEMENT, SharedCache
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import ViewerPoints, ViewerScene
from surfkit.io.splats.splat_table import SplatTable
from surfkit.mesh.base import Mesh
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame

COUNT = 3 * MAX_UNASKED_ITEMS


class Played:
    """A browser whose pictures take so long, and somebody who moves its camera and lets it rest in turn."""

    def __init__(self, fixed, each, wanted=1_000_000, first=None, noise=0.15, seed=0):
        self.fixed, self.each, self.wanted, self.noise = fixed, each, wanted, noise
        self.limit, self.now, self.draw = DrawLimit(first, 5_000), 0.0, np.random.default_rng(seed)
        self.changes, self.rates = [], []

    def takes(self, count):
        return (self.fixed + self.each * count) * math.exp(self.noise * self.draw.normal())

    def looks(self, seconds, moves):
        """One request a half of a second, of the last ten pictures; at rest one picture a second."""
        until, told, times, drawn = self.now + seconds, self.now, [], 0
        while self.now < until:
            count = self.limit.allowed(self.wanted, moves)
            assert count <= self.wanted
            times, drawn = (times, count) if count == drawn else ([], count)
            took = self.takes(count)
            self.now += took if moves else max(took, 1.0)
            times = [*times, took][-10:]
            if moves:
                self.rates.append((self.now, 1 / took))
            if self.now >= told + 0.5:
                before = self.limit.most
                self.limit.judge(times, count, self.wanted, self.now)
                told, times = self.now, []
                if self.limit.most != before:
                    self.changes.append(self.now)

    def plays(self, seconds=100.0):
        while self.now < seconds:
            self.looks(6.0, moves=True)
            self.looks(4.0, moves=False)
        return self

    def rate(self, since):
        return float(np.median([rate for at, rate in self.rates if at > since]))


@pytest.mark.parametrize(("fixed", "each"), [(0.01, 1.6e-6), (0.03, 1.5e-5), (0.0, 1e-7), (0.06, 1e-6), (0.005, 4e-7)])
@pytest.mark.parametrize("first", [None, 5_000, 40_000])
@pytest.mark.parametrize("seed", range(3))
def test_a_slow_browser_gets_what_it_can_draw_and_then_the_same(fixed, each, first, seed):
    played = Played(fixed, each, first=first, seed=seed).plays()
    assert played.rate(since=50) > 0.85 / LATE_S, "ten a second, and a little less where chance has it"
    late = [at for at in played.changes if at > 40]
    assert len(late) <= 1 and len(played.changes) <= 5, played.changes
    enough = 0.2 * (LATE_S - fixed) / each
    assert played.limit.allowed(10**9, True) > min(enough, 1_000_000) * 0.5, "and not much less than it can"


def test_a_fast_browser_keeps_everything():
    for each in (1e-9, 2e-8, 6e-8):
        played = Played(0.004, each).plays()
        assert played.limit.most is None and not played.changes


def test_a_browser_that_was_slow_for_a_while_gets_everything_again():
    played = Played(0.004, 1e-8)
    played.looks(5, True)
    played.each = 1e-6  # something else runs on that machine
    played.looks(10, True)
    assert played.limit.most < 200_000
    played.each = 1e-8
    played.looks(30, True)
    assert played.limit.allowed(1_000_000, True) == 1_000_000


def test_what_is_no_slowness_limits_nothing():
    limit = DrawLimit()
    for now in range(100):
        limit.judge([0.02, 0.02, 3.0, 0.02, 0.02], 1_000_000, 1_000_000, float(now))  # it collects garbage
        limit.judge([0.02, 5.0, 0.02], 1_000_000, 1_000_000, float(now))
        limit.judge([], 1_000_000, 1_000_000, float(now))  # hidden: nothing is drawn
    assert limit.most is None


def test_the_least_and_the_slider():
    limit = DrawLimit(least=5_000)
    for now in range(5):
        limit.judge([9.0, 9.0, 9.0], limit.allowed(10**6, True), 10**6, float(now))
    assert limit.most == 5_000 and limit.allowed(3_000, True) == 3_000
    assert limit.allowed(10**6, False) == REST_FACTOR * 5_000 and limit.allowed(8_000, False) == 8_000
    slow = DrawLimit(40_000)
    for now in range(0, 200, 20):  # all of a small number is in time: that tells nothing of a million
        slow.judge([0.001] * 5, 10_000, 10_000, float(now))
    assert slow.allowed(10**6, True) < 400_000


def test_pictures_at_rest_are_judged_by_what_moving_ones_would_take():
    limit = DrawLimit(40_000)
    for now in range(50):
        limit.judge([0.2] * 5, REST_FACTOR * 40_000, 10**6, float(now))
        limit.judge([0.06] * 5, REST_FACTOR * 40_000, 10**6, float(now))  # of which most may be for what stays
        assert limit.most == 40_000
    limit.judge([0.6] * 5, REST_FACTOR * 40_000, 10**6, 60.0)
    assert 10_000 < limit.most < 20_000


def test_a_limit_that_was_lowered_is_not_raised_at_once():
    limit = DrawLimit()
    limit.judge([0.2] * 5, 10**6, 10**6, 0.0)
    lowered = limit.most
    assert lowered == 333_333
    for now in (1.0, 5.0, 9.0):
        limit.judge([0.04] * 5, lowered, 10**6, now)
        assert limit.most == lowered
    limit.judge([0.04] * 5, lowered, 10**6, 11.0)
    assert limit.most == int(lowered * 5 / 3)
    limit.judge([0.001] * 5, limit.most, 2 * 10**7, 12.0)
    assert limit.most == 8 * int(lowered * 5 / 3), "and by no more than that at once"


def test_numbers():
    assert numbers("") == [] and numbers("1,2.5") == [1, 2.5] and len(numbers(",".join("1" * 100))) == 100
    for wrong in ("a", "1,", "-1", "nan", "inf", "1e999", "1,2," * 60, "9" * 5000):
        assert numbers(wrong) is None, wrong


def test_points_near_the_camera_are_more_likely():
    draw = torch.Generator().manual_seed(0)
    xyz = torch.cat([8 * torch.rand(40_000, 2, generator=draw) - 4, torch.full((40_000, 1), 1.0)], 1)
    pose = torch.eye(4, dtype=torch.float64)
    eye = LodCamera(Camera(pose, 100.0, 100.0, 50.0, 50.0, 100, 100), 0.01)
    rows, _ = SampledPoints(xyz).rows(1000, eye)
    chosen = xyz[rows]
    inside = (chosen[:, :2].abs() <= 0.55).all(1).float().mean()
    assert len(rows) == len(rows.unique()) == 1000 and inside > 0.6, "that is 2 % of the points"
    assert SampledPoints(xyz).rows(999)[0].shape == (999,)


def test_points_that_stand_for_others_cover_as_much():
    draw = np.random.default_rng(0)
    xyz = np.column_stack([draw.uniform(-0.4, 0.4, (4000, 2)), np.full(4000, 1.0)]).astype(np.float32)
    eye = LodCamera(Camera(torch.eye(4, dtype=torch.float64), 100.0, 100.0, 50.0, 50.0, 100, 100), 0.01)
    shelf = SharedCache(subject(points=ViewerPoints(xyz, np.zeros((4000, 3), np.uint8))))
    for count, exact in ((2000, 2**0.5), (1000, 2.0), (20, MAX_POINT_ENLARGEMENT)):
        rows, larger = shelf.points_for_eye(count, eye)
        assert len(rows) == count and larger == pytest.approx(exact, rel=0.1)


def table(count=COUNT):
    draw = torch.Generator().manual_seed(0)
    return SplatTable(
        "surfel",
        torch.randn(count, 3, generator=draw),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(),
        torch.full((count, 2), -4.0),
        torch.zeros(count),
        torch.randn(count, 3, generator=draw),
        torch.zeros(count, 0, 3),
    )


def subject(**parts):
    return ViewerScene(Path("s"), Frame(np.zeros(3), 1.0), np.array([0.0, 0, 1]), **parts)


def points(count=COUNT):
    xyz = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    return ViewerPoints(xyz, np.zeros((count, 3), np.uint8))


def tell(page, client, **asked):
    query = "&".join(f"{name}={value}" for name, value in {"client": client, **asked}.items())
    status, body, _ = get(page, f"/surfkit/pace?{query}", **cookie(page))
    return status, body.decode()


def client_of(browser):
    text = browser.wait_for(
        lambda b: next((r["content"] for r in b.gui.values() if "surfkit-pace" in str(r.get("content"))), None)
    )
    return text.split('data-client="')[1].split('"')[0]


@contextmanager
def shown(what, folder, **settings):
    needs("viser")
    with served(Address(), "test") as page:
        show(what, page, folder, **settings)
        yield page


@contextmanager
def looking(page, software):
    """A browser that says whether it has a graphics card."""
    browser = Browser(page.url)
    client = client_of(browser)
    assert tell(page, client, software=software, ms="", drawn="")[0] == 200
    browser.wait_for(Browser.is_whole)
    yield browser, client
    browser.close()


def count_in(browser):
    """What the line below the slider says is shown."""
    found = (re.match(r"(all )?([\d,]+) (of [\d,]+ )?(splats|points|triangles)", text) for text in browser.texts())
    return next((int(each[2].replace(",", "")) for each in found if each), 0)


def says(browser, words):
    return any(words in text for text in browser.texts())


def test_a_browser_without_a_graphics_card_begins_with_few_points_and_gets_as_many_as_it_can_draw(tmp_path):
    with (
        shown(subject(splats=table()), tmp_path) as page,
        looking(page, 1) as (slow, client),
        looking(page, 0) as (fast, other),
    ):
        assert count_in(slow) in (INITIAL_LIMITS["splats as points"], COUNT) and "point_size" in slow.names()["/splats"]
        slow.wait_for(lambda b: count_in(b) == COUNT)  # at rest, three times as many
        assert says(fast, f"all {COUNT:,} splats") and "buffer" in fast.names()["/splats"]
        told = len(fast.told)
        assert tell(page, client, software=1, ms="500,500,500,500,500", drawn=f"3,{COUNT},70")[0] == 200
        fewer = slow.wait_for(lambda b: 0 < count_in(b) < COUNT and count_in(b))
        assert says(slow, f"{fewer:,} splats") and says(slow, "This browser draws slowly")
        for browser in (client, other):  # of what the slow one had before; of a fast one
            assert tell(page, browser, software=1, ms="5,5,5,5,5", drawn=COUNT)[0] == 200
        slow.set("keep pace", False)
        slow.wait_for(lambda b: says(b, f"all {COUNT:,} splats are shown") and not says(b, "slowly"))
        assert not any(row.get("name") == "/splats" for row in fast.told[told:]), "the other is left alone"


def test_points_are_fewer_while_the_camera_moves(tmp_path):
    total, first = 10 * COUNT, INITIAL_LIMITS["points"]
    with shown(subject(points=points(total)), tmp_path) as page, looking(page, 1) as (browser, client):
        browser.wait_for(lambda b: count_in(b) == REST_FACTOR * first)
        assert says(browser, f"{REST_FACTOR * first:,} of {total:,} points are shown. This browser draws slowly")
        tell(page, client, software=1, ms="900,900,900,900,900", drawn=first)  # what it had before
        browser.stand(5.0)
        browser.wait_for(lambda b: count_in(b) == first)
        browser.wait_for(lambda b: count_in(b) == REST_FACTOR * first)
        for times in ("900,900", "900"):  # three that took more than a second are enough
            assert count_in(browser) == REST_FACTOR * first
            tell(page, client, software=1, ms=times, drawn=REST_FACTOR * first)
        browser.wait_for(lambda b: 0 < count_in(b) < REST_FACTOR * first / 2)


def test_a_mesh_keeps_pace_too(tmp_path):
    draw = np.random.default_rng(0)
    x, y = np.meshgrid(*[np.linspace(-1, 1, 250)] * 2)
    places = np.stack([x, y, 0.01 * draw.normal(size=x.shape)], -1).reshape(-1, 3).astype(np.float32)
    at = np.arange(250 * 250, dtype=np.int32).reshape(250, 250)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    mesh = Mesh(places, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    with shown(subject(mesh=mesh), tmp_path) as page, looking(page, 1) as (browser, client):
        first = count_in(browser)
        assert INITIAL_LIMITS["triangles"] / 3 < first <= INITIAL_LIMITS["triangles"] and says(browser, "draws slowly")
        tell(page, client, software=1, ms="300,300,300,300,300", drawn=3 * first)
        browser.wait_for(lambda b: MIN_LIMITS["triangles"] / 3 < count_in(b) <= MIN_LIMITS["triangles"])


def test_without_a_word_from_the_browser_nothing_is_limited(tmp_path, monkeypatch):
    monkeypatch.setattr("surfkit.apps.view.viewer_page.HELLO_S", 0.05)
    with shown(subject(points=points()), tmp_path) as page:
        browser = Browser(page.url)
        browser.wait_for(Browser.is_whole)
        assert count_in(browser) == COUNT and not says(browser, "slowly")
        late = client_of(browser)
        assert tell(page, late, software=1, ms="300,300,300,300,300", drawn=COUNT)[0] == 200
        browser.wait_for(lambda b: count_in(b) < COUNT)
        browser.close()


def test_who_asked_for_splats_gets_splats(tmp_path):
    with shown(subject(splats=table()), tmp_path, form="splats") as page, looking(page, 1) as (browser, _):
        assert "buffer" in browser.names()["/splats"]
        browser.wait_for(lambda b: count_in(b) == REST_FACTOR * INITIAL_LIMITS["splats"])


def test_requests_that_are_wrong_are_refused_in_a_line(tmp_path):
    with shown(subject(points=points(50)), tmp_path) as page, looking(page, 0) as (_, client):
        fine = {"software": 0, "ms": "5,5", "drawn": "50"}
        assert get(page, f"/surfkit/pace?client={client}&software=0&ms=&drawn=")[0] == 403
        assert tell(page, client, **fine) == (200, "")
        for wrong in ("", "-1", "77", "x", "²", "9" * 5000):
            assert tell(page, wrong.replace("²", "%C2%B2"), **fine) == (404, "no such client"), wrong
        wrongs = (("software", 2), ("software", ""), ("ms", "a"), ("ms", "nan"), ("drawn", "-5"), ("ms", "1,,2"))
        for name, value in wrongs:
            status, said = tell(page, client, **{**fine, name: value})
            assert status == 400 and len(said) < 90, (name, value)
        status, script, _ = get(page, "/surfkit/script.js", **cookie(page))
        assert status == 200 and b"surfkit/pace?" in script and b"surfkit/ask?" in script
