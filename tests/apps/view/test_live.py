"""A training that is looked at: it comes to the same bits, can be paused, and outlives whatever fails on the page."""

import json
import os
import re
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch
from browser import Browser, ask, tag, wait_until
from models import data_set
from needs import needs, needs_native

from surfkit.apps.view import live
from surfkit.apps.view.browser_camera import WORLD
from surfkit.apps.view.control import TrainingControl
from surfkit.apps.view.framed_pictures import BESIDE_GREY, FramedPictures, framed, window_of
from surfkit.apps.view.live import live_view, rest
from surfkit.apps.view.live_page import SceneWithoutModel
from surfkit.apps.view.measure_clicks import coordinates
from surfkit.apps.view.picking import surface_depth
from surfkit.apps.view.server import Address, listen
from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.partition import PictureShare, QuantileGrid
from surfkit.primitives.points import Points
from surfkit.raster.api import Maps
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.runs.run_stage import Intervals
from surfkit.train import checkpoint
from surfkit.train.refine import PruneAndRecover
from surfkit.train.state import StageState
from surfkit.train.view_order import ViewOrder
from surfkit.train.watch import Stopwatch, Watched, watched, watched_by

STEPS = 24
QUIET = Intervals(checkpoint=10, pictures=0)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return Data(data_set(tmp_path_factory.mktemp("live") / "data"))


@pytest.fixture(scope="module")
def scene(data):
    return read(data)


@pytest.fixture(scope="module")
def recipe():
    """Points are added and dropped within its few steps."""
    found = replace(with_steps(evolve(recipes()["2dgs"], "primitive.sh_degree", 1), STEPS), mesh=None)
    return evolve(found, "pretrain.densify.start", 2)


class Clock:
    """Of this process, and what has been added to it."""

    def __init__(self):
        self.added = 0.0

    def perf_counter(self):
        return time.perf_counter() + self.added

    def process_time(self):
        return time.process_time() + self.added


class Looking:
    """Draws everything after every step, and takes its time: an hour by the clock of the training."""

    def __init__(self, clock):
        self.told, self.drawn, self.clock = [], 0, clock

    def begin(self, stage):
        self.stage = stage
        self.told.append(stage.title)

    def look(self, index, psnr):
        lines = (self.stage.folder / "events.jsonl").read_text().splitlines()
        assert f'"index": {index},' in [line for line in lines if "StepDone" in line][-1], "the journal of this stage"
        for view in (*self.stage.scene.train[:2], *self.stage.scene.held_out[:1]):
            for geometry in (True, False):
                self.drawn += len(self.stage.draw(view, geometry).present())
        self.clock.added += 3600

    def end(self):
        self.told.append("end")


def equal(one, other):
    """Whether two states have the same bits, but for the times."""
    tensors = [
        {**each.points.params, **each.points.stats, **{f"moment {n}": v for n, v in vars(each.points).items()}}
        for each in (one, other)
    ]
    flat = [{name: value for name, value in each.items() if isinstance(value, torch.Tensor)} for each in tensors]
    assert flat[0].keys() == flat[1].keys() and flat[0]
    same = all(torch.equal(value, flat[1][name]) for name, value in flat[0].items())
    generators = torch.equal(one.generator.get_state(), other.generator.get_state())
    return same and generators and one.order.queue.tolist() == other.order.queue.tolist() and one.index == other.index


@pytest.fixture
def clock(monkeypatch):
    """By which steps are timed."""
    found = Clock()
    monkeypatch.setattr("surfkit.train.watch.time", found)
    return found


@needs_native
@pytest.mark.parametrize("blocks", [False, True])
def test_looking_changes_no_bit(data, recipe, tmp_path, capsys, clock, blocks):
    if blocks:
        parts = {"partition": QuantileGrid((2, 1)), "assign": PictureShare(), "context": "frozen"}
        refine = replace(PruneAndRecover(), stage=replace(PruneAndRecover().stage, steps=4))
        recipe = replace(recipe, tune=recipe.pretrain, refine=(refine,), **parts)
    before = torch.random.get_rng_state()
    run(recipe, data, tmp_path / "alone", Compute("cpu"), QUIET)
    looking = Looking(clock)
    with watched_by(looking):
        run(recipe, data, tmp_path / "watched", Compute("cpu"), QUIET)
    assert "goes on without it" not in capsys.readouterr().err
    assert torch.equal(torch.random.get_rng_state(), before)
    stages = ["pretrain", *["block 0", "block 1", "refine0"] * blocks]
    assert looking.told == [word for stage in stages for word in (stage, "end")]
    assert looking.drawn > 6 * STEPS
    for name in ["pretrain", *["blocks/000/tune", "blocks/001/tune", "refine0"] * blocks]:
        one, other = (checkpoint.load(tmp_path / way / name / "checkpoint.safetensors") for way in ("alone", "watched"))
        assert equal(one, other), name
    lines = [json.loads(line) for line in (looking.stage.folder / "events.jsonl").read_text().splitlines()]
    ended = [line["seconds"] for line in lines if line["event"] == "StageEnded"]
    assert 0 < ended[-1] < 3600, "looking does not count"
    clouds = [(tmp_path / way / "point_cloud.ply").read_bytes() for way in ("alone", "watched")]
    assert clouds[0] == clouds[1]


@needs_native
def test_a_watcher_that_fails_is_not_asked_again(data, recipe, tmp_path, capsys, clock):
    class Failing(Looking):
        def look(self, index, psnr):
            self.drawn += 1
            raise KeyError("page")

    failing = Failing(clock)
    with watched_by(failing):
        run(recipe, data, tmp_path / "run", Compute("cpu"), QUIET)
    assert failing.drawn == 1 and capsys.readouterr().err.count("goes on without it: KeyError: 'page'") == 1


def test_time_in_which_the_clock_is_stopped_does_not_count(clock):
    state = StageState(Points.fresh({}, {}), ViewOrder(1), torch.Generator())
    watch = Stopwatch(state)
    with watch.stopped():
        clock.added += 3600
    watch.lap()
    assert 0 < state.seconds < 3600 and 0 <= state.cpu_seconds < 3600
    clock.added += 7200
    watch.lap()
    assert 7200 < state.seconds < 10_800 and 7200 <= state.cpu_seconds < 10_800


class Training:
    """Steps in a thread, each of which takes a while; pictures are one colour, that of the number of the step.

    Within, at least one step is done.
    """

    def __init__(self, control, scene, folder, step_s=0.002, draw_s=0.0):
        self.control, self.step_s, self.draw_s = control, step_s, draw_s
        self.stage = Watched("pretrain", folder, scene, self.draw, lambda: self.stopping)
        self.stopping, self.index, self.drawn, self.over, self.error = False, 0, [], threading.Event(), None
        self.thread = threading.Thread(target=self.run)

    def __enter__(self):
        self.thread.start()
        wait_until(lambda: self.index)
        return self

    def __exit__(self, *_):
        self.over.set()
        self.control.pause(False)
        self.thread.join()
        assert not self.thread.is_alive()

    def run(self):
        with watched_by(self.control), watched(self.stage) as look:
            while not self.over.is_set():
                time.sleep(self.step_s)
                self.index += 1
                look(self.index, 20.0)

    def draw(self, view, geometry):
        time.sleep(self.draw_s)
        self.drawn.append((self.index, view, geometry))
        if self.error:
            raise self.error
        camera = view.camera
        color = torch.full((3, camera.height, camera.width), self.index % 100 / 100)
        plane = torch.full((camera.height, camera.width), 2.0)
        return Maps(color, plane.clamp(0, 1), plane, plane, torch.nn.functional.normalize(color + 1, dim=0))


def test_what_is_ordered_is_drawn_between_two_steps(scene, tmp_path):
    control, view = TrainingControl(), scene.train[0]
    with pytest.raises(BadInput, match="no step is being made"):
        control.draw(view, True)
    with Training(control, scene, tmp_path) as training:
        made = [control.draw(view, geometry) for geometry in (True, False)]
        assert [each.index for each in made] == [index for index, _, _ in training.drawn]
        assert [geometry for _, _, geometry in training.drawn] == [True, False]
        assert float(made[0].maps.color[0, 0, 0]) == pytest.approx(made[0].index % 100 / 100)
        training.error = MemoryError("none left")
        with pytest.raises(MemoryError):
            control.draw(view, True)
        before = training.index
        wait_until(lambda: training.index > before)  # the training goes on
    assert control.stage is None


def test_an_order_that_comes_too_late_is_given_back(scene, tmp_path):
    control = TrainingControl()
    control.begin(Watched("pretrain", tmp_path, scene, None, lambda: False))

    def end():
        wait_until(lambda: control.order is not None)
        control.end()

    thread = threading.Thread(target=end)
    thread.start()
    with pytest.raises(BadInput, match="no step is being made"):
        control.draw(scene.train[0], True)
    thread.join()


def test_a_pause_holds_the_training_and_pictures_go_on(scene, tmp_path, capsys):
    control = TrainingControl()
    with Training(control, scene, tmp_path) as training:
        control.pause(True)
        at = control.draw(scene.train[0], False).index  # of the step after which it waits
        assert control.draw(scene.train[0], False).index == at
        time.sleep(0.1)
        assert training.index == at
        control.pause(False)
        wait_until(lambda: training.index > at)
        control.pause(True)
        at = control.draw(scene.train[0], False).index
        training.stopping = True
        wait_until(lambda: training.index > at)  # a run that was asked to stop does not wait
    said = capsys.readouterr().err
    assert f"paused on the page after step {at}" in said and "goes on after step" in said


def test_psnr_of_steps_that_are_made_again(scene, tmp_path):
    control = TrainingControl()
    control.begin(Watched("pretrain", tmp_path, scene, None, lambda: False))
    for index, value in ((10, 20.0), (20, 21.0), (25, 1.0), (30, 22.0), (20, 23.0)):
        control.look(index, value)
    control.look(30, None)
    assert control.psnrs[tmp_path] == [(10, 20.0), (20, 23.0)]


def test_while_nobody_looks_nothing_is_drawn(scene, tmp_path, monkeypatch):
    needs("viser")
    monkeypatch.setattr("surfkit.apps.view.live_page.REFRESH_S", 0.0)
    with live_view(Address(), 0.5) as page, Training(page.control, scene, tmp_path) as training:
        wait_until(lambda: training.index > 50)
        assert not training.drawn
        browser = Browser(page.url)
        browser.wait_for(lambda b: len(backgrounds(b)) > 3)  # as often as it may
        browser.close()
        wait_until(lambda: not page.pages)
        before = len(training.drawn)
        time.sleep(0.5)
        assert len(training.drawn) <= before + 1, "but for one that had been ordered"


@pytest.mark.parametrize(("share", "error"), [(0.1, None), (0.6, None), (0.3, RuntimeError("no memory"))])
def test_pictures_take_their_share_of_the_time(scene, tmp_path, share, error):
    needs("viser")
    draw_s = 0.05
    with live_view(Address(), share) as page, Training(page.control, scene, tmp_path, 0.001, draw_s) as training:
        browser = Browser(page.url)
        browser.wait_for(backgrounds)
        browser.set("pixels", 160)
        training.error = error
        began = time.monotonic()
        before = len(training.drawn)
        for z in range(60):  # somebody who never rests
            browser.stand(float(z))
            with suppress(TimeoutError):
                browser.socket.recv(timeout=0.04)
        drawn = len(training.drawn) - before
        gone = time.monotonic() - began
        assert drawn * draw_s <= share * gone + draw_s
        browser.stand(0.0)
        browser.wait_for(lambda _: len(training.drawn) > before)
        browser.close()
    assert rest(1.0, 0.25) == 3.0


def backgrounds(browser):
    return [row for row in browser.told if row["type"] == "BackgroundImageMessage" and row["rgb_data"]]


def test_a_page_of_a_training(scene, tmp_path):
    needs("viser")
    with live_view(Address(), 1.0) as page, Training(page.control, scene, tmp_path) as training:
        browser = Browser(page.url)
        browser.wait_for(backgrounds)
        browser.wait_for(lambda b: any("After step" in text and "drawn by surfkit" in text for text in b.texts()))
        camera = training.drawn[-1][1].camera
        assert (camera.width, camera.height) == (640, 480) and camera.fy == pytest.approx(240 / np.tan(0.5))
        assert training.drawn[-1][2], "depths, for the coordinates under the pointer"
        browser.set("follow the pointer", False)
        browser.wait_for(lambda b: not training.drawn[-1][2])
        browser.set("pixels", 160)
        browser.set("show", "normal")
        browser.wait_for(lambda b: any("green up" in text for text in b.texts()))
        assert training.drawn[-1][2] and training.drawn[-1][1].camera.width == 160
        browser.set("show", "depth")
        browser.wait_for(lambda b: any("near is pale" in text for text in b.texts()))
        browser.set("cameras", True)
        browser.wait_for(lambda b: "/cameras" in b.names())
        camera, name = scene.train[2].camera, scene.train[2].name
        ahead = camera.world_to_camera[2, :3].numpy()
        browser.click((camera.centre.numpy() - 0.01 * ahead) * WORLD, ahead)
        browser.wait_for(lambda b: any(name in text and "beside the picture" in text for text in b.texts()))
        browser.wait_for(lambda b: "/cameras" not in b.names())
        assert training.drawn[-1][1].name == name
        browser.set("go to", "next")
        browser.wait_for(lambda b: any(scene.train[3].name in text for text in b.texts()))
        browser.set("camera", len(scene.train) + len(scene.held_out))
        last = scene.held_out[-1].name
        browser.wait_for(lambda b: any(last in text and "(held out)" in text for text in b.texts()))
        other = Browser(page.url)
        other.wait_for(lambda b: any(row.get("label") == "pause" and row.get("visible") for row in b.gui.values()))
        other.press("pause")
        browser.wait_for(lambda b: any(row.get("label") == "go on" for row in b.gui.values()))
        browser.set("from", "where I am")
        browser.wait_for(lambda b: any(f"After step {training.index:,}: near" in text for text in b.texts()))
        at = training.index
        time.sleep(0.1)
        assert training.index == at
        training.error = RuntimeError("CUDA error")
        browser.set("show", "render")
        browser.wait_for(lambda b: any("no picture: RuntimeError: CUDA error" in text for text in b.texts()))
        browser.press("go on")
        browser.wait_for(lambda _: training.index > at)
        browser.close()
        other.close()


def test_photographs_beside_pictures():
    left, right = np.zeros((30, 40, 3), np.uint8), np.full((30, 40, 3), 255, np.uint8)
    wide = framed([left, right], window_of((30, 80), 4.0))
    assert wide.shape == (30, 120, 3) and (wide[:, 20:60] == 0).all() and (wide[:, 60:100] == 255).all()
    tall = framed([left, right], window_of((30, 80), 1.0))
    assert tall.shape == (80, 80, 3) and (tall[25:55, :40] == 0).all() and (tall[:25] == 128).all()


@pytest.mark.parametrize(("count", "aspect"), [(1, 4 / 3), (1, 3.1), (2, 1.0), (2, 5.3)])
def test_pixels_of_a_window_show_the_places_that_are_drawn_there(scene, count, aspect):
    camera = scene.train[1].camera.fitted(40)
    draw = np.random.default_rng(1)
    depth = draw.uniform(0.5, 3.0, (camera.height, camera.width)).astype(np.float32)
    depth[2, :7], depth[3, 5] = 0, np.nan
    rows, columns = np.indices(depth.shape)
    image = np.stack([rows, columns, np.full_like(rows, 200)], 2).astype(np.uint8)
    window = window_of((camera.height, count * camera.width), aspect)
    whole, page = framed([image] * count, window), FramedPictures(camera, depth, count, window)
    hits = 0
    for row, column in np.stack([draw.integers(0, size, 400) for size in window], 1):
        place = page.place((column + draw.uniform(0, 1)) / window[1], (row + draw.uniform(0, 1)) / window[0])
        at, across, kind = whole[row, column].tolist()
        if kind == BESIDE_GREY or not depth[at, across] > 0:
            assert place is None
            continue
        hits += 1
        seen = camera.world_to_camera.numpy() @ [*place, 1.0]
        pixel = camera.fx * seen[0] / seen[2] + camera.cx, camera.fy * seen[1] / seen[2] + camera.cy
        assert np.allclose(pixel, (across + 0.5, at + 0.5)) and seen[2] == pytest.approx(depth[at, across])
    assert hits > 60
    assert page.place(1.0, 0.5) is None and page.place(0.5, -0.01) is None


def slowly(maps):
    time.sleep(0.2)
    return surface_depth(maps)


def test_coordinates_under_the_pointer(scene, tmp_path, monkeypatch):
    needs("viser")
    up = SceneWithoutModel(scene).first[0]
    with live_view(Address(), 1.0) as page, Training(page.control, scene, tmp_path) as training:
        browser = Browser(page.url)
        browser.wait_for(backgrounds)
        client, turn = tag(browser)
        browser.stand(3.0)  # looks along z, x to the right, y down; the picture is a plane in front of it
        browser.set("pixels", 800)
        browser.wait_for(lambda _: training.drawn[-1][1].camera.width == 800)
        browser.wait_for(lambda b: len(backgrounds(b)) > 1)
        column, row = 610, 77  # of 800 x 600
        x, y = (column + 0.5 - 400) / 300, (row + 0.5) / 300 - 1
        exact = np.array([2 * x * np.tan(0.5), 2 * y * np.tan(0.5), 3.0 / WORLD + 2])
        said = coordinates(exact, scene.frame, up)
        browser.wait_for(lambda _: ask(page.page, client=client, x=x, y=y) == (200, said))
        browser.wait_for(lambda b: tag(b)[1] != turn)  # another picture: the script asks again
        monkeypatch.setattr("surfkit.apps.view.live_page.surface_depth", slowly)  # the text comes when they are known
        browser.set("from", "a training camera")
        name = scene.train[0].name
        browser.wait_for(lambda b: any(name in text and "beside the picture" in text for text in b.texts()))
        camera = training.drawn[-1][1].camera
        (high, wide), column, row = window_of((camera.height, 2 * camera.width), 4 / 3), 7, camera.height - 3
        ray = (column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0
        pose = camera.world_to_camera.numpy()
        said = coordinates(pose[:3, :3].T @ (2 * np.array(ray) - pose[:3, 3]), scene.frame, up)
        for left in (0, camera.width):  # in the photograph, and in the picture
            x = ((wide - 2 * camera.width) // 2 + left + column + 0.5) / (high / 2) - 4 / 3
            y = ((high - camera.height) // 2 + row + 0.5) / (high / 2) - 1
            assert ask(page.page, client=client, x=x, y=y) == (200, said)
        assert ask(page.page, client=client, x=0.0, y=-0.99) == (200, ""), "grey"
        browser.set("follow the pointer", False)
        browser.wait_for(lambda b: tag(b)[0] == "")
        assert ask(page.page, client=client, x=0, y=0)[0] == 409
        browser.close()


def test_the_page_says_what_fails(scene, tmp_path, capsys, monkeypatch):
    needs("viser")
    with live_view(Address(), 1.0) as page, Training(page.control, scene, tmp_path) as training:
        browser = Browser(page.url)
        browser.wait_for(backgrounds)
        show = page.panel.show

        def refuse(out):
            raise BadInput("runs/x/recipe.json: damaged; copy it again")

        monkeypatch.setattr(page.panel, "show", refuse)
        browser.wait_for(lambda b: "panel: runs/x/recipe.json: damaged; copy it again" in b.texts())
        training.error = BadInput("what this run has made draws no normals")
        browser.set("show", "normal")
        browser.wait_for(lambda b: "no picture: what this run has made draws no normals" in b.texts())
        monkeypatch.setattr(page.panel, "show", show)
        browser.wait_for(lambda b: not any("damaged" in text for text in b.texts()))
        browser.close()
    assert "goes on" not in capsys.readouterr().err, "what a user can change is no matter of the terminal"


def test_the_first_view_shows_the_scene(scene):
    up, at, middle = SceneWithoutModel(scene).first
    assert np.isclose(np.linalg.norm(up), 1) and (at - middle) @ up > 0
    alone = replace(scene, train=scene.train[:1], held_out=())
    assert SceneWithoutModel(alone).size > 0 and np.isfinite(np.stack(SceneWithoutModel(alone).first)).all()


def drive(url, seen):
    """What a user does while a run goes on: waits for pictures and curves, pauses, and has it stopped."""
    browser, charts = Browser(url), {"loss", "PSNR of training views, dB"}
    try:
        browser.wait_for(backgrounds)
        browser.wait_for(lambda b: charts <= {row.get("title") for row in b.gui.values()})
        browser.press("pause")
        browser.wait_for(lambda b: any("**Paused.**" in text for text in b.texts()))
        seen += browser.texts()
    finally:
        os.kill(os.getpid(), signal.SIGINT)
        browser.close()


@needs_native
def test_a_run_with_a_page(data, tmp_path, capsys, monkeypatch):
    needs("viser")
    seen, out = [], tmp_path / "run"

    class Driven(live.Live):
        def __init__(self, *given):
            super().__init__(*given)
            threading.Thread(target=drive, args=(self.url, seen)).start()

    monkeypatch.setattr(live, "Live", Driven)
    words = ["train", "recipe:2dgs", "mesh:none", "--steps", "100000", "--primitive.sh-degree", "0", "--view"]
    words += ["--data", str(data.path), "--out", str(out), "--device", "cpu"]
    assert main(words) == 130
    said = capsys.readouterr().err
    assert "shown at http://127.0.0.1:" in said and "the page ends with the run" in said
    assert any(text.startswith("**pretrain** step ") and "points" in text for text in seen), seen
    listen(Address(port=int(re.search(r"127\.0\.0\.1:(\d+)", said)[1]))).close()
    state = checkpoint.load(out / "pretrain" / "checkpoint.safetensors")
    assert f"stopped after step {state.index} of" in said and "paused on the page" in said


def refusal(capsys, data, out, *words):
    """The one line in which a command is refused, before anything is written."""
    assert main(["train", "recipe:2dgs", "--data", str(data.path), "--out", str(out), *words]) == 2, words
    error = capsys.readouterr().err
    assert error.startswith("surfkit: ") and error.count("\n") == 1 and not out.exists(), error
    return error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--view", "--view-port", "0"], "--view-port 0: give 1 to 65535"),
        (["--view", "--view-share", "0"], "--view-share 0: give a share above 0"),
        (["--view", "--view-share", "1.5"], "--view-share 1.5: "),
        (["--view", "--view-share", "nan"], "--view-share nan: "),
        (["--view-port", "8080"], "--view-port: there is no page without --view"),
        (["--view-share=0.2"], "--view-share=0.2: there is no page without --view"),
    ],
)
def test_options_without_sense_are_refused(data, tmp_path, capsys, words, said):
    assert said in refusal(capsys, data, tmp_path / "run", *words)


def test_addresses_that_cannot_be_had_are_refused(data, tmp_path, capsys):
    needs("viser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        said = refusal(capsys, data, tmp_path / "run", "--view", "--view-port", port)
    assert f"--view-port {port}: Address already in use" in said
    assert "--view-host 198.51.100.7: " in refusal(
        capsys, data, tmp_path / "run", "--view", "--view-host", "198.51.100.7"
    )


def test_without_viser_one_line_says_what_to_install(data, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    said = refusal(capsys, data, tmp_path / "run", "--view")
    assert "surfkit train --view needs the package viser" in said and "pip install 'surfkit[view]'" in said
