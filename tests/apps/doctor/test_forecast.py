"""What a run will take: measured in another process, added up, and what is advised where it does not fit."""

import os
import shutil
import signal
from dataclasses import replace
from multiprocessing import active_children, spawn
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surfkit.apps.doctor.command import rows
from surfkit.apps.doctor.estimate import (
    FixedCosts,
    MachineLimits,
    MeshCosts,
    advice,
    duration,
    estimate,
    first_look,
    one_digit,
    slope,
)
from surfkit.apps.doctor.examine import examine
from surfkit.apps.doctor.few_photographs import Foretold
from surfkit.apps.doctor.forecast import ProbePlan, beyond, forecast, schedule, within
from surfkit.apps.doctor.growth import Growth, growth
from surfkit.apps.doctor.probe import (
    ProbeJob,
    ProbeOutput,
    ProbeResult,
    ProbeSegment,
    ProbeStart,
    SegmentCosts,
    measure,
    probe,
    some,
    with_count,
)
from surfkit.cli.recipes import recipes
from surfkit.core.memory import size
from surfkit.core.tree import evolve
from surfkit.densify.adc import ADC
from surfkit.densify.filters import CountCap
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.losses import NormalPrior, Reprojection
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.runs.pipeline import Intervals, run
from surfkit.runs.recipe import with_steps
from surfkit.scene.scene import SparsePoints
from surfkit.study.recipes.surface_recipes import SURFACE
from surfkit.testing.simulated_gpu import OnSimulatedGpu, simulated_gpu
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.refine.rendered_depth import RenderedDepth
from surfkit.train.trainer import Trainer

STARTED = ProbeStart(photo_seconds=0.4, init_seconds=3.0, held_bytes=1_000)
WRITTEN = ProbeOutput(700.0, 250.0, 10_000, 1.0, 5.0, 2_000_000_000)
ROOM = MachineLimits(10**12, 10**12, 10**12)
LOAD = FixedCosts(
    steps=1_000,
    train=100,
    held_out=10,
    view_bytes=4_000_000_000,
    budget_bytes=8_000_000_000,
    undistort=0,
    undistort_seconds=0.0,
    undistort_bytes=0.0,
    read_seconds=7.0,
    read_peak_bytes=5,
    checkpoint_every=500,
    threads=2,
)


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    """A data set that is never changed, whose cameras bend straight lines."""
    folder = tmp_path_factory.mktemp("made") / "farm"
    write_colmap(folder, photograph(Flight(kind="grid", views=8, width=64, height=48, points=300)))
    (folder / "sparse/0/cameras.txt").write_text("1 SIMPLE_RADIAL 64 48 58 33 24 -0.02\n")
    return folder


def probed(points=(1_000_000, 2_000_000), seconds=(1.0, 1.5), peaks=(3_000_000_000, 5_000_000_000)):
    taken = tuple(map(SegmentCosts, points, seconds, peaks))
    return ProbeResult(STARTED, taken, replace(WRITTEN, peak_bytes=max(peaks)))


def parts(*points):
    return tuple(ProbeSegment(at, count, 1 / len(points)) for at, count in enumerate(points))


def rising(last, known=True):
    return Growth(1_000_000, last, [at / 200 for at in range(1, 101)], known)


def test_points_are_not_charged_for_larger_photographs():
    points, divisor = np.array([1e5, 2e5, 3e5, 4e5]), np.array([4, 4, 1, 1])
    assert slope(points, 700 * points + 2e9 / divisor**2, divisor) == pytest.approx(700)
    assert slope(points, 700 * points, np.ones(4)) == pytest.approx(700)
    assert slope(np.array([1e5, 2e5]), np.array([1.0, 9.0]), np.array([4, 1])) == 0


def test_what_was_measured_is_added_up():
    found = estimate(LOAD, parts(1_000_000, 2_000_000), rising(2_000_000), probed(), ROOM)
    assert found.step_seconds == (1.0, 1.5) and found.points == 2_000_000
    assert found.memory_bytes == 5_000_000_000 - 1_000 + 4_000_000_000 and found.cache_bytes == 4_000_000_000
    assert found.point_bytes == 2_000
    assert found.run_bytes == 2_000_000 * (2 * 700 + 250) + 10 * 10_000 + 1_000 * 260
    assert found.seconds == pytest.approx(1_250 + 7 + 3 + 2 * 5 + 10 * 1.4)
    assert found.data_bytes == 0 and advice(found) == []


def test_points_beyond_the_probe_are_extrapolated_and_a_small_cache_reads_again():
    load = replace(LOAD, budget_bytes=1_000_000_000, undistort=40, undistort_seconds=0.6, undistort_bytes=9.0)
    found = estimate(load, parts(1_000_000, 4_000_000), rising(4_000_000), probed(), ROOM)
    assert found.step_seconds == pytest.approx((1.0, 1.5 + 2 * 0.5))
    assert found.memory_bytes == 5_000_000_000 - 1_000 + 2_000 * 2_000_000 + 1_000_000_000
    again = 1_000 * 0.75 * 0.4 / 2
    assert found.seconds == pytest.approx(1_750 + again + 7 + 40 * 0.6 / 2 + 3 + 2 * 5 * 2 + 10 * 1.4)
    assert found.data_bytes == 360


@pytest.mark.parametrize(
    "memory, words",
    [
        (9_500_000_000, "use --cache 4GB"),
        (
            5_000_000_000,
            "smaller photographs (--scale 2) need less, and so do fewer points: pretrain.densify.filters.0:",
        ),
        (1_000_000_000, "smaller photographs (--scale 2) need less with --cache 200MB"),
    ],
)
def test_what_to_lower_where_memory_is_short(memory, words):
    found = estimate(LOAD, parts(1_000_000, 2_000_000), rising(2_000_000), probed(), replace(ROOM, memory_bytes=memory))
    (finding,) = advice(found)
    assert finding.what == "memory" and words in finding.text and "about 9.0 GB of memory, and" in finding.text
    if "filters" in words:  # 0.9 x 5 GB hold 200 MB of photographs and so many points
        points = int(finding.text.partition("filters.0.points ")[2].split()[0])
        assert points == one_digit(2_000_000 - (5_000_000_000 - 1_000 + 200_000_000 - 4_500_000_000) / 2_000)


def test_what_to_lower_where_disk_or_time_is_short():
    load = replace(LOAD, steps=10**6, undistort=10, undistort_bytes=1e6)
    room = MachineLimits(10**12, 10**6, 10**7)
    found = estimate(load, parts(1_000_000, 2_000_000), rising(2_000_000), probed(), room)
    assert [finding.what for finding in advice(found)] == ["run-folder-disk", "undistorted-disk", "time"]


def test_numbers_in_words():
    assert [size(1.5e9), size(2.345e12), size(3e6), size(4e3)] == ["1.5 GB", "2.3 TB", "3 MB", "0 MB"]
    assert [duration(s) for s in (40, 720, 12_000, 270_000)] == ["40 s", "12 min", "3 h 20 min", "3 days 3 h"]
    assert [one_digit(n) for n in (7, 19.9, 123_456)] == [7, 10, 100_000]


def test_how_many_points_are_likely_allowed_or_given():
    stage = recipes()["2dgs"].pretrain
    likely = growth(stage, 10_000, 10**9)
    assert not likely.known and 6 * 10_000 < likely.last < 110 * 10_000
    assert likely.at(0) == likely.at(0.01) == 10_000 and likely.at(0.5) == likely.at(1) == likely.last
    counts = [likely.at(share / 10) for share in range(11)]
    assert counts == sorted(counts)
    assert growth(stage, 10_000, 100_000).last == 30_000  # no more than the photographs have pixels for
    raised = replace(stage, densify=ADC(threshold=2e-3))  # 2DGS in 15,000 and 30,000 steps on photographs of 160 px
    assert 55_782 / 2 < growth(raised, 17_816, 1_475_520).last < 43_003 * 2.1
    assert growth(stage, 10_000, 10**9, given=77_777).last == 77_777
    capped = replace(stage, densify=ADC(filters=(CountCap(points=50_000),)))
    assert (growth(capped, 10_000, 10**9).last, growth(capped, 10_000, 10**9).known) == (50_000, True)
    assert growth(capped, 60_000, 10**9).last == 60_000
    still = growth(replace(stage, densify=None), 10_000, 10**9)
    assert still.known and still.at(0.3) == still.last == 10_000


def test_parts_of_a_run_avoid_its_edits_and_the_limits_of_a_probe():
    middles = schedule(30_000, rising(2_000_000))
    assert [part.index for part in middles] == [3_040, 9_040, 15_040, 21_040, 27_040]
    assert sum(part.share for part in middles) == pytest.approx(1)
    assert [part.index for part in schedule(100, rising(9))] == [10, 30, 50, 70, 90]
    assert all(part.points <= 1_500_000 for part in within(middles, 1_500_000))
    few = [part.points for part in within(middles, 9_000)]
    assert few == sorted(set(few)) and few[-1] == 9_000


def test_what_comes_after_pretraining_is_named():
    found = [
        [finding.text for finding in beyond(recipe, Foretold())]
        for recipe in map(recipes().get, ("2dgs", "citygs2", "citygs"))
    ]
    assert found[0][0].endswith("the run needs more for: making the mesh") and "the blocks" in found[1][0]
    assert "the blocks" in found[2][0] and "what the model draws" not in found[2][0]
    refined = replace(recipes()["2dgs"], refine=(RenderedDepth(),))
    assert "depth maps from what the model draws" in beyond(refined, Foretold())[0].text
    assert "draws" not in beyond(refined, Foretold(refine_depth_seconds=1.0))[0].text
    assert beyond(replace(recipes()["2dgs"], mesh=None), Foretold()) == []
    assert beyond(recipes()["2dgs"], Foretold(mesh=MeshCosts(1.0, 1))) == []
    assert "depth maps" in beyond(recipes()["surface"], Foretold())[0].text
    assert "depth maps" not in beyond(recipes()["surface"], Foretold(depth_seconds=1.0))[0].text


def test_refinements_are_foretold_at_the_speed_of_the_last_steps(farm, monkeypatch):
    whole = probed((1_000_000,) * 5, (1.0,) * 5, (3_000_000_000,) * 5)
    monkeypatch.setattr("surfkit.apps.doctor.forecast.probe", lambda job, told: whole)
    data, recipe = Data(farm, test_every=0), replace(recipes()["2dgs"], mesh=None)
    stages = tuple(RenderedDepth(stage=replace(RenderedDepth().stage, steps=steps)) for steps in (700, 50))
    for refine, seconds in ((), 0.0), (stages, 750.0):
        refined = replace(recipe, refine=refine)
        found, _ = forecast(data, refined, examine(data, refined, quick=True), ProbePlan())
        assert found.refine_seconds == pytest.approx(seconds * found.step_seconds[-1]) and found.step_seconds[-1] > 0
        assert found.whole_seconds == pytest.approx(found.seconds + found.refine_seconds)
    assert any("after, to refine it" in text for _, text in rows(found))


def test_points_become_as_many_as_wanted(farm):
    primitive, draw = recipes()["2dgs"].primitive, torch.Generator().manual_seed(0)
    points = Points.fresh(primitive.init(read(Data(farm, test_every=0)).cloud, draw))
    for count in (1_000, 1_000, 170):
        points = with_count(primitive, points, count, draw)
        assert len(points) == count


def tiny(farm, tmp_path):
    scene = read(Data(farm, test_every=0))
    recipe = with_steps(evolve(recipes()["citygs2-coarse"], "primitive.sh_degree", 1), 400)
    return ProbeJob(recipe, some(scene, scene.train[:3]), parts(300, 900), 8, 60.0, True)


def test_what_a_probe_measures(farm, tmp_path):
    started, *taken, written = measure(tiny(farm, tmp_path))
    assert started.held_bytes >= 3 * (3 + 8) * 40 * 30 and started.photo_seconds > 0
    assert [abs(one.points / wanted - 1) < 0.1 for one, wanted in zip(taken, (300, 900), strict=True)] == [True] * 2
    assert all(one.seconds > 0 for one in taken) and taken[0].peak_bytes <= taken[1].peak_bytes <= written.peak_bytes
    columns = 3 + 2 + 4 + 1 + 4 * 3  # each with two moments, and a few statistics
    assert 3 * 4 * columns <= written.checkpoint_bytes < 3 * 4 * columns + 40  # and the header of the file


def with_loss(job, loss):
    return replace(job, recipe=evolve(job.recipe, "pretrain.losses.more", loss))


def test_made_up_priors_have_normals_where_a_loss_looks_at_them(farm, tmp_path):
    job = tiny(farm, tmp_path)
    plain, more = (next(measure(asked)).held_bytes for asked in (job, with_loss(job, NormalPrior())))
    pixels = sum(view.camera.width * view.camera.height for view in job.scene.train)
    assert more - plain == 3 * 4 * pixels, "float32 of three components"


def test_the_second_view_of_a_step_is_drawn_too(farm, tmp_path, monkeypatch):
    rasterizer, drawn = select("cpu")[0], []

    class Counting:
        where = rasterizer.where

        def render(self, *words):
            drawn.append(1)
            return rasterizer.render(*words)

    monkeypatch.setattr("surfkit.apps.doctor.probe.PART_S", 0.0)
    monkeypatch.setattr("surfkit.apps.doctor.probe.select", lambda device: (Counting(), ""))
    job = tiny(farm, tmp_path)
    counts = []
    for asked in (job, with_loss(job, Reprojection(start=0, every=1)), with_loss(job, Reprojection(start=0, every=2))):
        drawn.clear()
        list(measure(asked))
        counts.append(len(drawn))
    assert counts == [8 + 1, 16 + 1, 12 + 1]  # the last one is a picture


@pytest.mark.parametrize(("every", "seconds"), [(4, (1.25, 1.5)), (100, (1.01, 1.02))])
def test_steps_with_a_second_view_count_by_how_many_there_are(farm, tmp_path, monkeypatch, every, seconds):
    """Of 400, those above 100 that are a multiple of `every` take 3 s, and all others 1 s."""
    now = [0.0]

    def step(self, state):
        state.index += 1
        now[0] += 3 if state.index > 100 and state.index % every == 0 else 1

    monkeypatch.setattr(Trainer, "step", step)
    monkeypatch.setattr("surfkit.apps.doctor.probe.time", SimpleNamespace(perf_counter=lambda: now[0]))
    job = with_loss(tiny(farm, tmp_path), Reprojection(start=100, every=every))
    _, *taken, _ = measure(replace(job, steps=24))
    assert [one.seconds for one in taken] == pytest.approx(seconds)


def test_a_probe_that_is_killed_says_so(farm, tmp_path, forked_probe):
    job = tiny(farm, tmp_path)

    def kill(done, total):
        os.kill(active_children()[0].pid, signal.SIGKILL)

    found = probe(job, kill)
    assert found.written is None and "killed" in found.failure
    empty = SparsePoints(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
    broken = probe(replace(job, scene=replace(job.scene, cloud=empty)))
    assert "BadInput: the scene has no sparse points" in broken.failure and broken.taken == ()


def test_a_probe_that_dies_before_it_reads_its_job_says_so(farm, tmp_path, monkeypatch):
    """The job is larger than a pipe, into which nobody would write for ever."""
    job = tiny(farm, tmp_path)
    cloud = SparsePoints(torch.zeros(100_000, 3), torch.zeros(100_000, 3, dtype=torch.uint8))
    monkeypatch.setattr(spawn, "get_executable", lambda: os.fsencode(shutil.which("false") or ""))
    found = probe(replace(job, scene=replace(job.scene, cloud=cloud)))
    assert found.started is None and found.failure == "it crashed"


@pytest.mark.parametrize(
    "taken, failure, level, words",
    [
        (0, "BadInput: rates has none; give some", "error", "rates has none; give some"),
        (
            0,
            "RuntimeError: not enough memory",
            "error",
            "the probe ended before its first step: RuntimeError: not enough",
        ),
        (
            1,
            "the system killed it",
            "warning",
            "the probe ended with 900 points: the system killed it; if memory ran out",
        ),
    ],
)
def test_what_it_means_that_a_probe_ended_early(farm, monkeypatch, taken, failure, level, words):
    broken = ProbeResult(STARTED, probed().taken[:taken], None, failure)
    monkeypatch.setattr("surfkit.apps.doctor.forecast.probe", lambda job, told: broken)
    monkeypatch.setattr("surfkit.apps.doctor.forecast.schedule", lambda *_: parts(300, 900, 900, 900, 900))
    data, recipe = Data(farm, test_every=0), recipes()["2dgs"]
    found, (finding,) = forecast(data, recipe, examine(data, recipe, quick=True), ProbePlan())
    assert found is None and finding.level == level and finding.text.startswith(words)


def test_the_forecast_of_a_short_run_is_near_what_it_takes(farm, tmp_path, forked_probe):
    """Of the disk; memory and time depend on what else the machine does, and are looked at in bench/doctor.py."""
    farm = Path(shutil.copytree(farm, tmp_path / "farm", ignore=shutil.ignore_patterns("undistorted")))
    data, out = Data(farm, test_every=4), tmp_path / "run"
    recipe = with_steps(evolve(recipes()["3dgs"], "pretrain.densify", None), 60)
    before = {path for path in farm.rglob("*")}
    heard = []
    examined = examine(data, recipe)
    found, findings = forecast(data, recipe, examined, ProbePlan(10, out=out), lambda *words: heard.append(words))
    assert {path for path in farm.rglob("*")} == before and not out.exists()
    assert findings == [] and heard[-1][0] == "probe" and heard[-1][1] == heard[-1][2]
    assert found.points == 300 and found.points_known and found.seconds > 0
    run(recipe, data, out, intervals=Intervals(checkpoint=30, pictures=0))
    real = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    assert 0.75 * real < found.run_bytes < 1.25 * real
    undistorted = sum(path.stat().st_size for path in (farm / "undistorted").iterdir())
    assert 0.8 * undistorted < found.data_bytes < 1.2 * undistorted
    again, _ = forecast(data, recipe, examined, ProbePlan(10, out=out))
    assert again.data_bytes == 0  # they are there now


def test_the_memory_of_a_gpu_is_measured_and_added_up(farm, monkeypatch, tmp_path):
    monkeypatch.setattr(
        "surfkit.apps.doctor.probe.select", lambda device: (OnSimulatedGpu(select("cpu")[0]), "simulated")
    )
    job = replace(tiny(farm, tmp_path), parts=parts(200, 300, 600), steps=12)
    with simulated_gpu() as gpu:
        gpu.limit = 10**9
        started, *taken, _ = measure(job)
        assert 0.9e9 < started.gpu_free_bytes <= 1e9 and taken[-1].gpu_bytes <= gpu.peak
    found = estimate(LOAD, parts(200, 300, 600), rising(10**6), ProbeResult(started, tuple(taken), WRITTEN), ROOM).gpu
    columns = 3 * 4 * (3 + 2 + 4 + 1 + 4 * 3)  # parameters and moments, each of them float32
    assert columns < found.point_bytes < 10 * columns
    assert found.memory_bytes - found.cache_bytes == pytest.approx(10**6 * found.point_bytes, rel=0.2)
    assert found.cache_bytes == int(0.25 * found.free_bytes), "of 4 GB of photographs"


@pytest.mark.parametrize(
    "free, words",
    [
        (10**10, None),
        (5 * 10**9, "about 8.0 GB of the memory of the GPU, and 4.5 GB can be used: smaller photographs (--scale 2)"),
    ],
)
def test_what_to_lower_where_a_gpu_is_small(free, words):
    taken = (SegmentCosts(1_000_000, 0.5, 10**9, 4 * 10**9), SegmentCosts(2_000_000, 0.5, 10**9, 8 * 10**9))
    started = replace(STARTED, gpu_free_bytes=free)
    found = estimate(LOAD, parts(10**6, 2 * 10**6), rising(2_000_000), ProbeResult(started, taken, WRITTEN), ROOM)
    assert found.gpu.memory_bytes == 8 * 10**9 + min(LOAD.view_bytes, free // 4)
    assert [finding.what for finding in advice(found)] == ["gpu-memory"] * (words is not None)
    assert words is None or words in advice(found)[0].text and "filters.0.points 1000000" in advice(found)[0].text
    assert estimate(LOAD, parts(10**6, 2 * 10**6), rising(2_000_000), probed(), ROOM).gpu is None


@pytest.mark.parametrize(
    "memory, disk, words",
    [
        (
            5 * 10**9,
            10**12,
            "; --points-on disk with --cache 200MB takes at most 3.8 GB of memory and 1.4 GB of",
        ),
        (5 * 10**9, 4 * 10**9, None),  # the run folder takes 3.3 GB of it
        (4 * 10**9, 10**12, None),
        (9_500_000_000, 10**12, None),  # a smaller cache will do
    ],
)
def test_points_in_files_where_memory_is_short(memory, disk, words):
    room = replace(ROOM, memory_bytes=memory, run_bytes=disk)
    given = parts(1_000_000, 2_000_000), rising(2_000_000), probed(), room
    text = advice(estimate(replace(LOAD, movable=True), *given))[0].text
    assert words in text if words else "--points-on" not in text
    assert "--points-on" not in advice(estimate(LOAD, *given))[0].text, "steps that look at all points need all of them"


@pytest.mark.parametrize(
    "free, memory, disk, words",
    [
        (
            8 * 10**9,
            10**12,
            10**12,
            "; --points-on host leaves at most 6.6 GB there, and takes 1.4 GB of the memory",
        ),
        (8 * 10**9, 25 * 10**8, 10**12, "; --points-on disk leaves at most 6.6 GB there, and takes 1.4 GB of the disk"),
        (8 * 10**9, 25 * 10**8, 4 * 10**9, None),
        (5 * 10**9, 10**12, 10**12, None),
    ],
)
def test_points_elsewhere_where_a_gpu_is_small(free, memory, disk, words):
    taken = (SegmentCosts(1_000_000, 0.5, 10**9, 4 * 10**9), SegmentCosts(2_000_000, 0.5, 10**9, 8 * 10**9))
    started, load = replace(STARTED, gpu_free_bytes=free), replace(LOAD, movable=True, budget_bytes=0)
    result = ProbeResult(started, taken, replace(WRITTEN, peak_bytes=10**9))
    found = estimate(load, parts(10**6, 2 * 10**6), rising(2_000_000), result, MachineLimits(memory, disk, 10**12))
    texts = {finding.what: finding.text for finding in advice(found)}
    assert words in texts["gpu-memory"] if words else "--points-on" not in texts["gpu-memory"]


def test_points_that_begin_dense_multiply_less():
    """By runs of recipe:surface: steps, points at the beginning and at the end."""
    measured = [
        (1_000, 178_403, 192_182),
        (3_000, 178_403, 258_159),
        (700, 131_896, 182_641),
        (3_500, 131_896, 439_368),
    ]
    for steps, first, last in measured:
        stage = with_steps(SURFACE, steps).pretrain
        dense = growth(stage, first, 30_000_000, is_dense=True)
        assert last / 1.7 < dense.last < last * 1.7
        assert dense.at(0) == first and dense.at(1) == dense.last
    whole = growth(SURFACE.pretrain, 484_693, 18_000_000, is_dense=True)
    assert whole.last < 5 * 484_693 < growth(SURFACE.pretrain, 484_693, 18_000_000).last


@pytest.mark.parametrize(("seconds", "count"), [(3_600, 0), (4 * 3_600, 1)])
def test_a_first_look_is_proposed_where_the_run_takes_hours(seconds, count):
    found = estimate(LOAD, parts(1_000_000, 2_000_000), rising(2_000_000), probed(), ROOM)
    notes = first_look(replace(found, seconds=float(seconds)))
    assert len(notes) == count and all("recipe:surface-short" in note.text and "4 h" in note.text for note in notes)
