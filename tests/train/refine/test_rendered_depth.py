"""Training that goes on with depth maps which begin at what the model draws."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.core.check import BadInput
from surfkit.core.tree import evolve
from surfkit.depth.depth_anything import DepthAnythingV2
from surfkit.depth.fill_monocular import MonocularFill
from surfkit.depth.filled import Filled
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_map_index import read_made
from surfkit.io.datasets.fingerprint import digest, fingerprint
from surfkit.io.datasets.read import read
from surfkit.losses.depth import DepthRegression
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.raster.select import select
from surfkit.runs import run_refinements
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import load_run, run
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_cache import inputs_of, part_keys
from surfkit.runs.run_stage import Intervals, drawing
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings
from surfkit.train.refine import PruneAndRecover
from surfkit.train.refine.rendered_depth import RenderedDepth
from surfkit.train.stage import Stage

pytestmark = needs_native
QUICK = PatchMatch(coarsest=32, window=3, passes=1, rounds=1, neighbours=3)
DEPTH = Stage().losses | {"depth": DepthRegression(start=2.5, end=2.5)}
REFINED = RenderedDepth(depth=QUICK, stage=Stage(steps=4, losses=DEPTH, densify=None))
EVERY = Intervals(checkpoint=2, pictures=0)


@pytest.fixture(scope="module")
def farm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "farm"
    write_colmap(folder, photograph(Flight(kind="grid", views=8, width=48, height=36, points=300)), tracks=True)
    return Data(folder)


@pytest.fixture
def recipe():
    plain = Recipe(pretrain=Stage(steps=6, densify=None), refine=(REFINED,))
    return evolve(plain, "primitive.sh_degree", 0)


def watched(monkeypatch):
    """What stereo was given to begin with, by the name of the view."""
    seen, match = {}, PatchMatch.estimate

    def estimate(self, given, wanted):
        for at in wanted:
            view = given.views[at]
            seen[view.name] = given.known.see(at, self.of_map(view.camera)), view
        yield from match(self, given, wanted)

    monkeypatch.setattr(PatchMatch, "estimate", estimate)
    return seen


def test_stereo_begins_at_what_the_model_draws_and_the_stage_learns_from_its_maps(
    farm, recipe, tmp_path, own_cache, monkeypatch
):
    seen = watched(monkeypatch)
    metrics = run(recipe, farm, tmp_path, Compute("cpu"), EVERY)
    (folder,) = (own_cache / "depth").iterdir()
    made = read_made(folder)
    assert made.maps == len(seen) == 7, "of the training photographs; no others were made for the run"
    loaded, _, scene = load_run(tmp_path)
    assert not loaded.wants_priors and loaded.data.priors is None
    before = checkpoint.load_last(tmp_path / "pretrain" / "checkpoint.safetensors")[0]
    draw = drawing(loaded.stages[0], before, select("cpu")[0])
    for known, view in seen.values():
        maps = draw(view)
        there = maps.median > 0
        assert there.any()
        torch.testing.assert_close(known.inverse[there] * maps.median[there], torch.ones(int(there.sum())))
        assert not known.inverse[~there].any()
        length = known.normal.norm(dim=0)[maps.alpha > 0.5]
        torch.testing.assert_close(length, torch.ones_like(length))
    events = (tmp_path / "refine0" / "events.jsonl").read_text().splitlines()
    steps = [event for event in map(json.loads, events) if event["event"] == "StepDone"]
    assert len(steps) == 4 and any(step["losses"].get("depth", 0) > 0 for step in steps)
    after = checkpoint.load_last(tmp_path / "refine0" / "checkpoint.safetensors")[0]
    assert metrics["cpu_seconds"] == after.cpu_seconds > before.cpu_seconds + made.cpu_seconds, "maps count"


def test_interrupted_in_every_part_and_gone_on_with(farm, recipe, tmp_path, own_cache, monkeypatch):
    """To the same bits, with maps that are made once."""
    run(recipe, farm, tmp_path / "whole", Compute("cpu"), EVERY)
    for path in (own_cache / "depth").iterdir():
        path.rename(tmp_path / "other")
    estimate, save, made = PatchMatch.estimate, checkpoint.save, []

    def stopping(self, given, wanted):
        for found in estimate(self, given, wanted):
            if len(made) == 3:
                made.append(None)
                raise KeyboardInterrupt
            made.append(found.at)
            yield found

    def stop(path, state):
        save(path, state)
        if path.parent.name == "refine0" and state.index == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(PatchMatch, "estimate", stopping)
    monkeypatch.setattr(checkpoint, "save", stop)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run(recipe, farm, tmp_path / "out", Compute("cpu"), EVERY)
    monkeypatch.setattr(checkpoint, "save", save)
    run(recipe, farm, tmp_path / "out", Compute("cpu"), EVERY)
    assert sorted(at for at in made if at is not None) == list(range(7))
    assert (tmp_path / "out/point_cloud.ply").read_bytes() == (tmp_path / "whole/point_cloud.ply").read_bytes()


def test_a_stage_that_goes_on_with_other_maps_says_so(farm, recipe, tmp_path, own_cache, monkeypatch):
    save, text = checkpoint.save, "refine0: what depth maps are made from, or how, has changed"

    def stop(path, state):
        save(path, state)
        if path.parent.name == "refine0":
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "save", stop)
    for _ in range(2):  # after 2 of 5 steps, and after 4
        with pytest.raises(KeyboardInterrupt):
            run(evolve(recipe, "refine.0.stage.steps", 5), farm, tmp_path, Compute("cpu"), EVERY)
        assert text not in (tmp_path / "run.json").read_text()
    monkeypatch.setattr(checkpoint, "save", save)
    monkeypatch.setattr(PatchMatch, "version", 1000)
    run(evolve(recipe, "refine.0.stage.steps", 5), farm, tmp_path, Compute("cpu"), EVERY)
    assert text in (tmp_path / "run.json").read_text()


def test_a_second_refinement_makes_maps_anew_and_fills_them(farm, recipe, tmp_path, own_cache):
    twice = replace(recipe, refine=(REFINED, replace(REFINED, depth=Filled(stereo=QUICK))))
    run(twice, farm, tmp_path, Compute("cpu"), EVERY)
    assert [read_made(folder).maps for folder in (own_cache / "depth").iterdir()] == [7, 7]


def test_other_depth_of_the_same_points_gives_other_maps(farm, recipe, tmp_path, own_cache, monkeypatch):
    """Points that were trained to the same bits, without a loss on depth, but drawn otherwise, or by other code."""
    recipe, made = replace(recipe, primitive=Gaussian3D(sh_degree=0)), []
    for name, geometry, version in (
        ("axis", "axis", "1"),
        ("plane", "plane", "1"),
        ("new", "plane", "2"),
        ("again", "plane", "2"),
    ):
        monkeypatch.setattr(run_refinements, "versions", lambda _, version=version: {"surfkit": version})
        run(evolve(recipe, "primitive.geometry", geometry), farm, tmp_path / name, Compute("cpu"), EVERY)
        made.append(len(list((own_cache / "depth").iterdir())))
    points = [
        checkpoint.load_last(tmp_path / name / "pretrain" / "checkpoint.safetensors")[0] for name in ("axis", "plane")
    ]
    torch.testing.assert_close(*(state.points.params for state in points), rtol=0, atol=0)
    assert made == [1, 2, 3, 3]


@pytest.mark.parametrize(
    ("refine", "caches", "told"),
    [
        (REFINED, CacheSettings(maps=None), r"--no-prepare: refine\.0 makes depth maps"),
        (
            replace(REFINED, depth=replace(QUICK, window=17, scale=4)),
            None,
            r"refine\.0 cannot make its depth maps: .*window",
        ),
        (
            replace(REFINED, depth=Filled(stereo=QUICK, fill=MonocularFill(maps="/nowhere"))),
            None,
            r"refine\.0 cannot make its depth maps: fill\.maps is /nowhere",
        ),
        (REFINED, None, r"cannot be written .*SURFKIT_CACHE to a folder for depth maps, or leave refine\.0 out"),
    ],
)
def test_maps_that_cannot_be_made_are_told_before_anything_is_trained(
    farm, recipe, tmp_path, own_cache, monkeypatch, refine, caches, told
):
    if "SURFKIT_CACHE" in told:
        (tmp_path / "file").write_text("no folder")
        monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path / "file"))
    with pytest.raises(BadInput, match=told):
        run(replace(recipe, refine=(refine,)), farm, tmp_path / "out", Compute("cpu"), EVERY, caches)
    assert not (tmp_path / "out").exists()


def test_a_refined_run_needs_no_maps_any_more_until_it_is_made_longer(farm, recipe, tmp_path, own_cache):
    none = CacheSettings(maps=None)
    run(recipe, farm, tmp_path, Compute("cpu"), EVERY)
    run(recipe, farm, tmp_path, Compute("cpu"), EVERY, none)
    with pytest.raises(BadInput, match="--no-prepare"):
        run(evolve(recipe, "pretrain.steps", 8), farm, tmp_path, Compute("cpu"), EVERY, none)


@pytest.mark.parametrize("wrong", [{"depth": PlaneSweep()}, {"depth": DepthAnythingV2()}, {"stage": Stage()}])
def test_what_cannot_begin_or_would_be_in_vain_is_refused(wrong):
    with pytest.raises(BadInput, match="rendered-depth"):
        RenderedDepth(**wrong)


def test_the_maps_of_a_run_are_another_thing(farm, recipe, tmp_path):
    """A run wants some only if another part looks at them; what is shared depends on how its own are made."""
    for refine, wants in ((REFINED, False), (PruneAndRecover(stage=REFINED.stage), True)):
        assert Run(tmp_path, replace(recipe, refine=(refine,)), farm).wants_priors == wants
    keys = [
        part_keys(replace(recipe, refine=(one,), depth=depth))["refine0"]
        for one, depth in (
            (REFINED, None),
            (REFINED, PlaneSweep()),
            (replace(REFINED, depth=replace(QUICK, rounds=2)), None),
        )
    ]
    assert keys[0] == keys[1] != keys[2]


def test_other_files_of_its_estimator_make_another_stage(farm, recipe, tmp_path):
    """Maps of a network that were made again in the same folder must not be taken for those of before."""
    scene, maps = read(farm), tmp_path / "estimated_depths"
    prints = fingerprint(scene)
    maps.mkdir()
    for view in scene.train:
        np.save(maps / f"{view.name}.npy", np.ones((4, 4), np.float32))
    refine = replace(REFINED, depth=Filled(stereo=QUICK, fill=MonocularFill(maps=str(tmp_path))))

    def keys(refine=refine):
        made = Run(tmp_path / "run", replace(recipe, refine=(refine,)), farm)
        return part_keys(made.recipe, inputs_of(made, "cpu", prints, scene.train))

    first = keys()
    assert keys() == first
    np.save(maps / f"{scene.train[1].name}.npy", np.ones((5, 4), np.float32))
    assert keys()["refine0"] != first["refine0"] and keys()["pretrain"] == first["pretrain"]
    shutil.rmtree(maps)
    assert keys()["refine0"] != first["refine0"], "which are not there is told later, if they are needed"


def test_a_model_that_differs_anywhere_has_maps_of_its_own():
    """In words, long arrays are cut short: models would share their maps."""
    params = {"means": torch.zeros(5000, 3), "opacities": torch.zeros(5000)}
    other = params | {"means": params["means"].clone()}
    other["means"][2500, 1] = 1e-3
    keys = {digest(["axis", *one.values()]) for one in (params, other)} | {digest(["plane", *params.values()])}
    assert len(keys) == 3
    assert digest(params) != digest(other) and digest(params) == digest(dict(reversed(params.items())))
