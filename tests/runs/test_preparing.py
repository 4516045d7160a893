"""Depth maps that a run makes by itself: kept in a cache, made once, gone on with, and refused."""

import json
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forks import started

from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.core.lock import IN_USE_FILE, is_used, locked, mark_used
from surfkit.core.tree import evolve
from surfkit.depth.depth_map_cache import make_room
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import map_path
from surfkit.io.datasets.depth_map_index import folder_of, located, read_made
from surfkit.losses import DepthRegression, NormalPrior
from surfkit.partition import PictureShare, QuantileGrid
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.execute import Pool
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe
from surfkit.start.stereo_start import StereoStart
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train.data_cache import CacheSettings
from surfkit.train.stage import Stage
from surfkit.train.trainer import Trainer

SWEEP = PlaneSweep(longest=32, neighbours=2, max_planes=16)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "farm"
    write_colmap(folder, photograph(Flight(kind="grid", views=8, width=48, height=36, points=300)), tracks=True)
    return folder


@pytest.fixture
def farm(made, tmp_path):
    """A data set with tracks; one of its eight photographs is held out."""
    torch.set_num_threads(1)
    return Data(Path(shutil.copytree(made, tmp_path / "farm")))


@pytest.fixture
def recipe():
    losses = Stage().losses | {"depth": DepthRegression()}
    stage = Stage(steps=12, losses=losses, densify=None)
    return evolve(Recipe(depth=SWEEP, start=StereoStart(points=400), pretrain=stage), "primitive.sh_degree", 0)


def contents(folder):
    """Every file in a folder and when it was written."""
    return {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*"))}


def maps(cache):
    return {path.name: path.read_bytes() for path in sorted(cache.rglob("estimated_depths/*.npy"))}


def own_maps(farm):
    """Let a data set have the maps of SWEEP."""
    words = (
        "estimator:plane-sweep --estimator.longest 32 --estimator.neighbours 2 --estimator.max-planes 16 --test-every 8"
    )
    assert main(f"prepare depth {farm.path} {words}".split()) == 0


def record(out):
    return json.loads((out / "run.json").read_text())


def counting(monkeypatch, stop_after=None):
    """The positions that the sweep estimates; it is interrupted after so many."""
    seen, estimate = [], PlaneSweep.estimate

    def watched(self, given, wanted):
        for found in estimate(self, given, wanted):
            if stop_after is not None and len(seen) == stop_after:
                raise KeyboardInterrupt
            seen.append(given.views[found.at].name)
            yield found

    monkeypatch.setattr(PlaneSweep, "estimate", watched)
    return seen


def test_a_run_makes_its_maps_once_and_leaves_the_data_alone(farm, recipe, tmp_path, own_cache, monkeypatch):
    before, seen = contents(farm.path), counting(monkeypatch)
    metrics = run(recipe, farm, tmp_path / "a")
    assert contents(farm.path) == before
    (folder,) = (own_cache / "depth").iterdir()
    assert seen == [f"view_{at:03d}.png" for at in range(1, 8)]  # the first is held out
    assert len(maps(own_cache)) == 14 and read_made(folder).maps == 7
    assert not (folder / "estimated_depths/.work").exists()
    assert metrics["prepare_cpu_seconds"] == round(read_made(folder).cpu_seconds, 2) > 0
    (note,) = record(tmp_path / "a")["notes"]
    assert note.startswith("depth maps of 7 photographs, made with plane-sweep in ") and note.endswith(
        f", are in {folder}"
    )
    assert record(tmp_path / "a")["data"]["priors"] == str(folder)

    again = run(recipe, farm, tmp_path / "b")
    assert len(seen) == 7, "the maps are there already"
    assert again["prepare_cpu_seconds"] == metrics["prepare_cpu_seconds"]
    assert (tmp_path / "a/point_cloud.ply").read_bytes() == (tmp_path / "b/point_cloud.ply").read_bytes()
    assert run(recipe, farm, tmp_path / "b") == again


def test_a_start_from_stereo_is_denser_and_on_the_surface(farm, recipe, tmp_path):
    from surfkit.train.checkpoint import load

    run(recipe, farm, tmp_path / "a")
    points = load(tmp_path / "a/pretrain/checkpoint.safetensors").points
    run(replace(recipe, start=Recipe().start), farm, tmp_path / "b")
    sparse = load(tmp_path / "b/pretrain/checkpoint.safetensors").points
    assert len(sparse) == 300 and 390 < len(points) < 700
    assert points.params["opacities"].sigmoid().median() > 0.4 > sparse.params["opacities"].sigmoid().median()


def test_other_maps_are_made_when_what_they_are_made_from_differs(farm, recipe, tmp_path, own_cache):
    changed = {
        "first": (recipe, farm),
        "estimator": (evolve(recipe, "depth.window", 7), farm),
        "split": (recipe, replace(farm, test_every=4)),
        "size": (recipe, replace(farm, longest=40)),
        "seed": (evolve(recipe, "seed", 3), farm),
    }
    kept = []
    for name, (recipe, data) in changed.items():
        run(recipe, data, tmp_path / name)
        kept.append(len(list((own_cache / "depth").iterdir())))
    assert kept == [1, 2, 3, 4, 4], "only the seed changes no map"


def test_another_photograph_or_version_of_the_estimator_is_another_key(farm, recipe, tmp_path, own_cache, monkeypatch):
    run(recipe, farm, tmp_path / "a")
    monkeypatch.setattr(PlaneSweep, "version", 2)
    run(recipe, farm, tmp_path / "b")
    photo = farm.path / "images/view_003.png"
    shutil.copy(farm.path / "images/view_004.png", photo)
    run(recipe, farm, tmp_path / "c")
    assert len({record(tmp_path / name)["data"]["priors"] for name in "abc"}) == 3


def test_an_interrupted_estimate_goes_on_to_the_same_maps(farm, recipe, tmp_path, own_cache, monkeypatch):
    run(recipe, farm, tmp_path / "whole")
    expected, points = maps(own_cache), (tmp_path / "whole/point_cloud.ply").read_bytes()
    shutil.rmtree(own_cache / "depth")
    with monkeypatch.context() as patch:
        counting(patch, stop_after=3)
        with pytest.raises(KeyboardInterrupt):
            run(recipe, farm, tmp_path / "run")
    (folder,) = (own_cache / "depth").iterdir()
    spent = read_made(folder).cpu_seconds
    assert read_made(folder).maps == 3 and spent > 0 and not (tmp_path / "run/recipe.json").exists()
    seen = counting(monkeypatch)
    run(recipe, farm, tmp_path / "run")
    assert len(seen) == 4 and maps(own_cache) == expected
    assert record(tmp_path / "run")["prepare_cpu_seconds"] > spent
    assert (tmp_path / "run/point_cloud.ply").read_bytes() == points


def test_a_run_whose_maps_were_deleted_makes_them_again_and_ends_the_same(
    farm, recipe, tmp_path, own_cache, monkeypatch
):
    run(recipe, farm, tmp_path / "whole")
    take, steps = Trainer.step, []

    def stopped(self, state):
        steps.append(1)
        if len(steps) == 6:
            raise KeyboardInterrupt
        return take(self, state)

    from surfkit.runs.run_stage import Intervals

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", stopped)
        with pytest.raises(KeyboardInterrupt):
            run(recipe, farm, tmp_path / "run", intervals=Intervals(checkpoint=2))
    shutil.rmtree(own_cache / "depth")
    with pytest.raises(BadInput, match="leave out --no-prepare"):
        run(recipe, farm, tmp_path / "run", caches=CacheSettings(maps=None))
    seen = counting(monkeypatch)
    run(recipe, farm, tmp_path / "run")
    assert len(seen) == 7
    ends = [(tmp_path / name / "point_cloud.ply").read_bytes() for name in ("run", "whole")]
    assert ends[0] == ends[1]
    shutil.rmtree(own_cache / "depth")
    metrics = run(recipe, farm, tmp_path / "run")  # finished: nothing needs maps
    assert len(seen) == 7 and metrics["prepare_cpu_seconds"] > 0
    (tmp_path / "run/metrics.json").unlink()
    assert run(recipe, farm, tmp_path / "run")["prepare_cpu_seconds"] > 0


def test_without_preparing_the_loss_is_off_and_a_dense_start_is_refused(farm, recipe, tmp_path, own_cache, monkeypatch):
    seen = counting(monkeypatch)
    with pytest.raises(BadInput, match="depth .*--no-prepare .*depth:patch-match.*start:sparse") as refused:
        run(recipe, farm, tmp_path / "a", caches=CacheSettings(maps=None))
    assert "\n" not in str(refused.value) and not (tmp_path / "a").exists()
    sparse = replace(recipe, start=Recipe().start)
    metrics = run(sparse, farm, tmp_path / "b", caches=CacheSettings(maps=None))
    (note,) = record(tmp_path / "b")["notes"]
    assert "has no depth priors, so everything" in note and metrics["prepare_cpu_seconds"] is None
    assert not seen and not (own_cache / "depth").exists()


def test_a_loss_of_normals_that_the_maps_do_not_have_is_warned_of(farm, recipe, tmp_path):
    recipe = evolve(recipe, "pretrain.losses.prior", NormalPrior())
    tune = replace(recipe.pretrain, steps=6, sh_every=1)
    recipe = replace(recipe, partition=QuantileGrid((2, 1)), assign=PictureShare(), tune=tune, min_views=1)
    for _ in range(2):  # the second time, nothing is left to do
        run(recipe, farm, tmp_path / "run")
        made, without = record(tmp_path / "run")["notes"]
        assert "made with plane-sweep" in made and "7 of 7 depth priors have no normals" in without
        assert "loss normal-prior" in without and "depth:patch-match" in without


def test_a_run_that_began_without_maps_goes_on_without(farm, recipe, tmp_path, own_cache):
    sparse = replace(recipe, start=Recipe().start)
    run(sparse, farm, tmp_path / "run", caches=CacheSettings(maps=None))
    load_state = json.loads((tmp_path / "run/recipe.json").read_text())
    del load_state["depth"], load_state["start"]  # as surfkit of before wrote it
    (tmp_path / "run/recipe.json").write_text(json.dumps(load_state))
    (tmp_path / "run/metrics.json").unlink()
    longer = evolve(sparse, "pretrain.steps", 16)
    assert run(longer, farm, tmp_path / "run")["steps"] == 16
    assert not (own_cache / "depth").exists()


def test_maps_of_the_data_set_come_first(farm, recipe, tmp_path, own_cache, monkeypatch):
    own_maps(farm)
    seen = counting(monkeypatch)
    metrics = run(recipe, farm, tmp_path / "own")
    assert record(tmp_path / "own")["notes"] == []
    assert not seen and not (own_cache / "depth").exists() and metrics["prepare_cpu_seconds"] is None
    shutil.rmtree(farm.path / "estimated_depths")
    run(recipe, farm, tmp_path / "made")
    assert len(seen) == 7
    ends = [(tmp_path / name / "point_cloud.ply").read_bytes() for name in ("own", "made")]
    assert ends[0] == ends[1]


def test_maps_of_the_data_set_that_were_made_otherwise_are_told(farm, recipe, tmp_path):
    own_maps(farm)
    for at, (depth, how) in enumerate(
        (
            (replace(SWEEP, window=7), "with other settings of plane-sweep than the recipe has"),
            (PatchMatch(), "with plane-sweep, not with patch-match"),
            (None, None),
        )
    ):
        for _ in range(2):  # the second time, nothing is left to do
            run(replace(recipe, depth=depth), farm, tmp_path / f"run{at}")
        told = f"has depth maps, made {how}: the run uses these; move the folder away to have others made"
        notes = record(tmp_path / f"run{at}")["notes"]
        assert notes == ([] if how is None else [f"{farm.path / 'estimated_depths'} {told}"])
    run(replace(recipe, depth=PatchMatch()), farm, tmp_path / "none", caches=CacheSettings(maps=None))
    (note,) = record(tmp_path / "none")["notes"]
    assert note.endswith("the run uses these"), "others would not be made"
    path = farm.path / "estimated_depths" / "depth.json"
    whole = json.loads(path.read_text())
    for side, more in ((24, " and from photographs of 24 px, where the run has such of 48 px"), (96, "")):
        path.write_text(json.dumps(whole | {"longest": side}))
        run(replace(recipe, depth=replace(SWEEP, longest=64, window=7)), farm, tmp_path / f"small{side}")
        (note,) = record(tmp_path / f"small{side}")["notes"]
        assert f"other settings of plane-sweep than the recipe has{more}: " in note
    for at, other in enumerate(("", ', "estimator": "x"', ', "estimator": 7', ', "estimator": {"a": 1}')):  # foreign
        (farm.path / "estimated_depths" / "depth.json").write_text(f'{{"aligned": true{other}}}')
        run(recipe, farm, tmp_path / f"foreign{at}")
        assert record(tmp_path / f"foreign{at}")["notes"] == []


def test_a_model_without_tracks_trains_without_maps(tmp_path, recipe, own_cache):
    write_colmap(tmp_path / "farm", photograph(Flight(views=4, width=24, height=18, points=40)))
    with pytest.raises(BadInput, match="there are none that can be used"):
        run(recipe, Data(tmp_path / "farm"), tmp_path / "a")
    run(replace(recipe, start=Recipe().start), Data(tmp_path / "farm"), tmp_path / "b")
    notes = record(tmp_path / "b")["notes"]
    assert any(note.startswith("depth maps cannot be made: ") and "`surfkit prepare points" in note for note in notes)
    assert not (own_cache / "depth").exists()


def test_a_damaged_photograph_gets_no_map(farm, recipe, tmp_path, own_cache):
    photo = farm.path / "images/view_003.png"
    photo.write_bytes(photo.read_bytes()[:400])
    run(recipe, farm, tmp_path / "run")
    (folder,) = (own_cache / "depth").iterdir()
    assert read_made(folder).maps == 6 and read_made(folder).without == ("view_003.png",)
    assert record(tmp_path / "run")["skipped"] == ["view_003.png"]


def test_photographs_that_are_all_damaged_are_one_line(farm, recipe, tmp_path, own_cache):
    for photo in (farm.path / "images").iterdir():
        photo.write_bytes(photo.read_bytes()[:400])
    with pytest.raises(BadInput, match="7 photographs .*png for one"):
        run(recipe, farm, tmp_path / "run")
    assert not maps(own_cache)


def test_a_data_set_that_cannot_be_written_to_is_no_matter(farm, recipe, tmp_path, own_cache):
    folders = [farm.path, *(path for path in farm.path.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    try:
        run(recipe, farm, tmp_path / "run")
    finally:
        for folder in folders:
            folder.chmod(0o755)
    assert len(maps(own_cache)) == 14


def test_a_cache_that_cannot_be_written_to_is_one_line(farm, recipe, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path / "file"))
    with pytest.raises(BadInput, match="cannot be written .*SURFKIT_CACHE") as error:
        run(recipe, farm, tmp_path / "run")
    assert "\n" not in str(error.value) and not (tmp_path / "run").exists()


def test_worker_elsewhere_finds_the_maps_in_its_own_cache_or_says_so(own_cache, tmp_path):
    there = tmp_path / "other/depth/0123"
    with pytest.raises(BadInput, match="SURFKIT_CACHE .*both see"):
        located(there)
    (folder_of("0123") / "estimated_depths").mkdir(parents=True)
    assert located(there) == own_cache / "depth/0123"
    (there / "estimated_depths").mkdir(parents=True)
    assert located(there) == there


def entry(cache, name, size, age):
    folder = cache / "depth" / name
    (folder / "estimated_depths").mkdir(parents=True)
    np.save(folder / "estimated_depths/a.npy", np.zeros(size, np.uint8))
    (folder / IN_USE_FILE).touch()
    os.utime(folder / IN_USE_FILE, (time.time() - age,) * 2)
    return folder


def test_those_longest_unused_go_when_the_cache_is_full(own_cache):
    old, older, mine = (entry(own_cache, name, 10_000, age) for name, age in (("b", 50), ("a", 90), ("c", 99)))
    (own_cache / "depth/.dropped-x").mkdir()
    make_room(mine, 1 << 20)
    assert old.exists() and older.exists() and not (own_cache / "depth/.dropped-x").exists()
    make_room(mine, 25_000)
    assert old.exists() and not older.exists() and mine.exists()
    with mark_used(old):
        make_room(mine, 0)
        assert old.exists() and is_used(old)
    with locked(old):
        make_room(mine, 0)
        assert old.exists()
    make_room(mine, 0)
    assert [path.name for path in (own_cache / "depth").iterdir()] == ["c"]


def test_making_maps_makes_room(farm, recipe, tmp_path, own_cache):
    other = entry(own_cache, "other", 10_000, 50)
    run(recipe, farm, tmp_path / "run", caches=CacheSettings(maps="1MB"))
    assert other.exists()
    run(evolve(recipe, "depth.window", 7), farm, tmp_path / "b", caches=CacheSettings(maps="1KB"))
    (left,) = (own_cache / "depth").iterdir()
    assert str(left) == record(tmp_path / "b")["data"]["priors"]
    with pytest.raises(BadInput, match="--prepare-cache lots: give a size"):
        run(recipe, farm, tmp_path / "c", caches=CacheSettings(maps="lots"))
    with pytest.raises(BadInput, match="--prepare-cache -1GB: .*4GB or 500MB$"):
        run(recipe, farm, tmp_path / "c", caches=CacheSettings(maps="-1GB"))
    with pytest.raises(BadInput, match="--prepare-cache auto: .*20GB"):
        run(recipe, farm, tmp_path / "c", caches=CacheSettings(maps="auto"))


def test_two_processes_make_the_maps_once(farm, recipe, tmp_path, own_cache):
    from surfkit.core.codec import write_json

    write_json(tmp_path / "recipe.json", recipe)
    words = ["train", f"recipe:{tmp_path / 'recipe.json'}", "--data", str(farm.path), "--pictures-every", "0", "--out"]
    both = [started([*words, str(tmp_path / name)], tmp_path / f"{name}.log") for name in "ab"]
    for process in both:
        process.join()
    told = [(tmp_path / f"{name}.log").read_text() for name in "ab"]
    assert [process.exitcode for process in both] == [0, 0], told
    assert len(list((own_cache / "depth").iterdir())) == 1
    costs = [record(tmp_path / name)["prepare_cpu_seconds"] for name in "ab"]
    assert costs[0] == costs[1]
    assert (tmp_path / "a/point_cloud.ply").read_bytes() == (tmp_path / "b/point_cloud.ply").read_bytes()


@pytest.mark.usefixtures("forked_jobs")
def test_blocks_in_processes_of_their_own_find_the_maps(farm, recipe, tmp_path, own_cache, monkeypatch, capsys):
    tune = replace(recipe.pretrain, steps=6, sh_every=1)
    recipe = replace(recipe, partition=QuantileGrid((2, 1)), assign=PictureShare(), tune=tune, min_views=1)
    out = tmp_path / "run"
    run(recipe, farm, out, Compute("cpu", Pool(2)))
    assert not [note for note in record(out)["notes"] if not note.startswith("depth maps of 7")]
    run(recipe, farm, tmp_path / "inline")
    assert (out / "point_cloud.ply").read_bytes() == (tmp_path / "inline/point_cloud.ply").read_bytes()
    with monkeypatch.context() as patch:  # a machine that does not see the cache
        patch.setenv("SURFKIT_CACHE", str(tmp_path / "elsewhere"))
        (own_cache / "depth").rename(own_cache / "gone")
        shutil.rmtree(tmp_path / "inline/blocks/000/tune")
        state = tmp_path / "inline/blocks/000/state.json"
        assert main(["train-block", str(tmp_path / "inline"), "0"]) == 2
        err = capsys.readouterr().err
        assert "set SURFKIT_CACHE to a folder that both see" in err and state.exists()
        (own_cache / "gone").rename(tmp_path / "elsewhere-too")
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "elsewhere-too").rename(tmp_path / "elsewhere/depth")
        assert main(["train-block", str(tmp_path / "inline"), "0"]) == 0


def test_the_words_of_the_command_line(farm, tmp_path, own_cache, capsys):
    words = ["train", "recipe:2dgs", "start:stereo", "depth:plane-sweep", "--data", str(farm.path), "--steps", "5"]
    words += ["--depth.longest", "40", "--start.points", "200", "mesh:none", "--out", str(tmp_path / "run")]
    assert main([*words, "--no-prepare"]) == 2
    assert "surfkit prepare depth" in capsys.readouterr().err
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "depth maps" in out and "depth maps  7/7" in err
    assert main(words) == 0 and "is finished" in capsys.readouterr().err
    assert not map_path(farm.path, "view_001.png").exists() and len(maps(own_cache)) == 14


WEIGHED = ["mesh:tsdf", "--mesh.least-views", "0.01"]
WEIGHED += ["mesh.trust:agreement", "--mesh.trust.priors", "weigh", "--mesh.trust.tolerance", "0.5"]


def test_a_mesh_of_a_run_without_maps_has_them_made(farm, recipe, tmp_path, own_cache, monkeypatch, capsys):
    sparse = replace(recipe, start=Recipe().start, pretrain=replace(recipe.pretrain, losses=Stage().losses))
    run(sparse, farm, tmp_path / "run")
    seen, before, words = counting(monkeypatch), contents(farm.path), ["mesh", str(tmp_path / "run")]
    assert main([*words, "mesh:tsdf"]) == 0 and not seen, "this one does not look at them"
    capsys.readouterr()
    for mesher in (["mesh:stereo"], WEIGHED):
        assert main([*words, *mesher, "--no-prepare"]) == 2
        told = capsys.readouterr().err.splitlines()
        assert len(told) == 1 and "leave out --no-prepare" in told[0] and f"prepare depth {farm.path}`" in told[0]
    assert not seen and not (own_cache / "depth").exists()
    assert main([*words, "mesh:stereo"]) == 0 and len(seen) == 7 and contents(farm.path) == before
    told = capsys.readouterr().err
    assert "depth maps  7/7" in told and "note: depth maps of 7 photographs, made with plane-sweep in" in told
    assert main([*words, *WEIGHED]) == 0 and len(seen) == 7, "the maps are in the cache"
    assert json.loads((tmp_path / "run/mesh.json").read_text())["mesher"]["trust"]["priors"] == "weigh"


def test_a_mesh_has_maps_made_again_that_are_gone_and_looks_at_those_of_the_data_set(
    farm, recipe, tmp_path, own_cache, monkeypatch, capsys
):
    run(recipe, farm, tmp_path / "run")
    seen, words = counting(monkeypatch), ["mesh", str(tmp_path / "run"), "mesh:stereo"]
    assert main([*words, "--no-prepare"]) == 0 and not seen, "those of the run are there"
    (before,) = (own_cache / "depth").iterdir()
    shutil.rmtree(own_cache / "depth")
    assert main([*words, "--no-prepare"]) == 2 and main(words) == 0
    assert len(seen) == 7 and list((own_cache / "depth").iterdir()) == [before]
    shutil.copytree(before / "estimated_depths", farm.path / "estimated_depths")
    shutil.rmtree(own_cache / "depth")
    assert main(words) == 0 and len(seen) == 7 and not (own_cache / "depth").exists()
    shutil.rmtree(farm.path / "estimated_depths")
    run(replace(recipe, depth=None, start=Recipe().start), farm, tmp_path / "none")
    capsys.readouterr()
    assert main(["mesh", str(tmp_path / "none"), "mesh:stereo"]) == 2
    note, error = capsys.readouterr().err.splitlines()
    assert f"`surfkit prepare depth {farm.path}`" in note and "mesh:stereo fuses depth priors, and there" in error


def test_training_given_again_with_another_mesher_has_its_maps_made(farm, tmp_path, own_cache, monkeypatch, capsys):
    out, seen = tmp_path / "run", counting(monkeypatch)
    sweep = ["depth:plane-sweep", "--depth.longest", "32", "--depth.neighbours", "2", "--depth.max-planes", "16"]
    words = ["train", "recipe:2dgs", *sweep, "--data", str(farm.path), "--steps", "5", "--out", str(out)]
    assert main([*words, "mesh:none"]) == 0 and not seen
    points = (out / "point_cloud.ply").read_bytes()
    assert main([*words, "mesh:stereo", "--no-prepare"]) == 0 and not seen
    (note,) = record(out)["notes"]
    assert note.startswith("there is no mesh: ") and "leave out --no-prepare to make them" in note
    assert main([*words, "mesh:stereo"]) == 0 and len(seen) == 7 and (out / "point_cloud.ply").read_bytes() == points
    made = (out / "mesh.ply").read_bytes()
    capsys.readouterr()
    assert main([*words, "mesh:stereo"]) == 0 and "is finished" in capsys.readouterr().err and len(seen) == 7
    assert main(["mesh", str(out), "mesh:stereo"]) == 0 and (out / "mesh.ply").read_bytes() == made
