"""What a few photographs tell of a run, against runs and surfaces of which all is known."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn.functional import interpolate

from surfkit.apps.doctor import few_photographs
from surfkit.apps.doctor.command import rows
from surfkit.apps.doctor.examine import examine
from surfkit.apps.doctor.few_photographs import foretell, times_the_surface
from surfkit.apps.doctor.forecast import ProbePlan, forecast
from surfkit.cli.recipes import recipes
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.depth.base import Estimate
from surfkit.depth.filled import Filled
from surfkit.depth.patch_match import PatchMatch
from surfkit.io.datasets.data import Data
from surfkit.mesh.base import Mesh, Mesher
from surfkit.runs.pipeline import Intervals, run
from surfkit.runs.recipe import with_steps
from surfkit.start.stereo_start import StereoStart
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.refine.rendered_depth import RenderedDepth

FLIGHTS = {
    "nadir": Flight(kind="grid", views=30, width=120, height=90, points=2_000, test_every=0),
    "orbit": Flight(kind="orbit", views=20, width=120, height=90, points=1_500, test_every=0),
    "small": Flight(kind="grid", views=14, width=60, height=45, points=900, test_every=0),
}
SHORT = with_steps(recipes()["surface-short"], 4)


class Clock:
    """Depth maps that are exact take a second for a hundred of their pixels, and nothing else takes any time."""

    def __init__(self, flight):
        truth = photograph(flight)
        self.exact = {view.name: truth.exact[view.name].depth for view in truth.scene.train}
        self.now, self.sizes = 0.0, []

    def estimate(self, own, given, wanted):
        for at in wanted:
            camera = own.of_map(given.views[at].camera)
            depth = interpolate(self.exact[given.views[at].name][None, None], (camera.height, camera.width))[0, 0]
            inverse = torch.where(depth > 0, 1 / depth, 0).float()
            self.now += inverse.numel() / 100
            self.sizes.append(tuple(inverse.shape))
            yield Estimate(at, inverse, (inverse > 0).float(), torch.zeros(3, *inverse.shape))


def scene(folder, flight, monkeypatch):
    """The data set of a flight, and the clock of its depth maps."""
    monkeypatch.setenv("SURFKIT_CACHE", str(folder / "cache"))
    monkeypatch.setattr(few_photographs, "LONGEST_PX", 60)
    clock = Clock(flight)
    monkeypatch.setattr(PatchMatch, "estimate", lambda own, *given: clock.estimate(own, *given))
    monkeypatch.setattr(few_photographs, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    write_colmap(folder / "farm", photograph(flight), tracks=True)
    return Data(folder / "farm", test_every=0), clock


def told(data, recipe, folder):
    return foretell(data, examine(data, recipe, quick=True), recipe, "cpu", folder)


@pytest.mark.parametrize("name", FLIGHTS)
def test_depth_maps_and_points_at_the_start_are_those_of_the_run(name, tmp_path, monkeypatch):
    data, clock = scene(tmp_path, FLIGHTS[name], monkeypatch)
    recipe = replace(SHORT, mesh=None)
    found = told(data, recipe, tmp_path / "few")
    assert len(clock.sizes) == 12 and max(clock.sizes) <= (24, 30), "half as large as photographs of 60 px"
    begun, plain, clock.now = [], StereoStart.cloud, 0.0
    monkeypatch.setattr(StereoStart, "cloud", lambda self, known: begun.append(plain(self, known)) or begun[-1])
    run(recipe, data, tmp_path / "run", intervals=Intervals(pictures=0))
    assert found.depth_seconds == pytest.approx(clock.now, rel=0.1)
    count = len(begun[0].xyz)
    assert found.points is not None and count / 1.25 < found.points < 1.25 * count
    limited = replace(recipe, start=replace(recipe.start, most=100))
    assert told(data, limited, tmp_path / "limited").points == 100


def test_filled_maps_are_foretold_by_their_own_size(tmp_path, monkeypatch):
    data, _ = scene(tmp_path, FLIGHTS["orbit"], monkeypatch)
    whole, half = (replace(SHORT, mesh=None, depth=PatchMatch(scale=scale)) for scale in (1, 4))
    each = [told(data, recipe, tmp_path / f"{at}").depth_seconds for at, recipe in enumerate((whole, half))]
    assert each[0] == pytest.approx(20 * 120 * 90 / 100, rel=0.02) and each[1] == pytest.approx(each[0] / 16, rel=0.1)
    monkeypatch.setattr(Filled, "estimate", lambda own, *given: own.stereo.estimate(*given))
    filled = replace(half, depth=Filled(stereo=PatchMatch(scale=4)))
    assert told(data, filled, tmp_path / "filled").depth_seconds == pytest.approx(each[1])


def test_maps_that_refinements_make_are_foretold(tmp_path, monkeypatch):
    data, clock = scene(tmp_path, FLIGHTS["orbit"], monkeypatch)
    coarse, fine = (RenderedDepth(depth=PatchMatch(scale=scale)) for scale in (4, 2))
    none = replace(recipes()["2dgs"], mesh=None)
    assert told(data, none, tmp_path / "none").refine_depth_seconds == 0 and not clock.sizes
    found = told(data, replace(none, refine=(coarse, fine, coarse)), tmp_path / "three")
    assert found.refine_depth_seconds == pytest.approx(20 * 120 * 90 / 100 * (1 / 16 + 1 / 4 + 1 / 16), rel=0.1)
    assert found.depth_seconds == 0 and len(clock.sizes) == 2 * 12, "each kind of map once"


CLOCK = SimpleNamespace(now=0.0)


@dataclass(frozen=True)
class Costly(Mesher):
    """Takes a second to begin with, a tenth of a second and a second for a thousand pixels of each view, and three for
    a thousand pixels of them all."""

    most: int | None = None
    """Most triangles."""

    refuses: bool = False
    """Whether there is no surface."""

    @property
    def most_triangles(self):
        return self.most

    def mesh(self, subject):
        if self.refuses:
            raise BadInput("no surface")
        CLOCK.now += 1.0
        pixels = 0
        for at, view in enumerate(subject.views, 1):
            CLOCK.now += 0.1 + view.camera.width * view.camera.height / 1_000
            pixels += view.camera.width * view.camera.height
            emit(Progress("drawing", at, len(subject.views)))
        CLOCK.now += 3 * pixels / 1_000
        emit(Progress("counting", 1, 1))
        faces = np.arange(3 * 1_000, dtype=np.int32).reshape(-1, 3)
        places = np.random.default_rng(0).random((3_000, 3)).astype(np.float32)
        return Mesh(places, faces)


def test_the_mesh_grows_with_the_views_and_with_the_surface(tmp_path, monkeypatch):
    flight = FLIGHTS["nadir"]
    data, _ = scene(tmp_path, flight, monkeypatch)
    monkeypatch.setattr(few_photographs, "time", SimpleNamespace(perf_counter=lambda: CLOCK.now))
    monkeypatch.setattr(few_photographs, "times_the_surface", lambda *given: 1.5)
    recipe = replace(SHORT, mesh=Costly())
    pixels = flight.width * flight.height
    by_view, by_surface = 30 * (0.1 + pixels / 1_000), 3 * 1.5 * 12 * pixels / 1_000
    found = told(data, recipe, tmp_path / "few").mesh
    assert found.seconds == pytest.approx(1 + by_view + by_surface, rel=0.05)
    least = told(data, replace(recipe, mesh=Costly(most=500)), tmp_path / "most").mesh
    assert least.seconds < 1 + by_view + 0.2 * by_surface, "a mesh that is made no larger takes no longer"
    assert told(data, replace(recipe, mesh=Costly(refuses=True)), tmp_path / "none").mesh is None


def test_surface_counts_by_area_and_not_by_texture():
    rng = np.random.default_rng(0)
    places = np.zeros((30_000, 3))
    places[:, :2] = rng.random((30_000, 2)) * (4, 1)
    places[:20_000, 0] *= 0.25  # two thirds of the points lie in the first quarter, which has more texture
    first = np.flatnonzero(places[:, 0] < 1)
    every = np.arange(30_000)
    assert times_the_surface(places, every, first) == pytest.approx(4, rel=0.3)
    assert len(every) / len(first) < 1.5
    assert times_the_surface(places, every, every) == 1


def test_without_tracks_nothing_is_told_and_a_note_says_what_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path / "cache"))
    write_colmap(tmp_path / "farm", photograph(FLIGHTS["small"]))
    data, recipe = Data(tmp_path / "farm", test_every=0), with_steps(recipes()["2dgs"], 4)
    examined = examine(data, recipe, quick=True)
    assert foretell(data, examined, recipe, "cpu", tmp_path / "few") == few_photographs.Foretold()
    estimate, findings = forecast(data, recipe, examined, ProbePlan(steps=5))
    assert estimate.mesh is None and "making the mesh" in findings[0].text
    assert dict(rows(estimate))["points"].startswith("900 at the start; at the end")


def test_the_doctor_tells_maps_mesh_and_points_of_a_surface(tmp_path, monkeypatch):
    data, _ = scene(tmp_path, FLIGHTS["small"], monkeypatch)
    estimate, findings = forecast(data, SHORT, examine(data, SHORT, quick=True), ProbePlan(steps=5))
    assert estimate.depth_seconds > 0 and estimate.mesh is not None and estimate.first > 0
    table = rows(estimate)
    assert any("before, for depth maps" in text for _, text in table)
    assert any("after, for the mesh, with" in text for _, text in table)
    assert not [finding for finding in findings if finding.what == "forecast"]
