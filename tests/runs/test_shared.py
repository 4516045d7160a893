"""Which parts of a run are the same as another run's, and that taking them changes nothing."""

import json
from dataclasses import fields, replace

import pytest
from listening import listening
from two_blocks import EVERY, data, recipe, same, undisturbed

from surfkit.compress.vectree import Vectree
from surfkit.core.events import StageBegan
from surfkit.densify.prune import PruneByImportance
from surfkit.densify.trim import Trim
from surfkit.io.datasets.fingerprint import fingerprint
from surfkit.io.datasets.read import read
from surfkit.losses.depth import DepthRegression
from surfkit.mesh.tsdf import TSDF
from surfkit.runs import run_cache as shared
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.folder import Run
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_cache import inputs_of, part_keys, read_shared
from surfkit.runs.stage_cache import StageCache
from surfkit.study.recipes import RECIPES
from surfkit.train import checkpoint

__all__ = ["data", "recipe", "undisturbed"]

FULL = replace(RECIPES["citygs2"], mesh=TSDF(), compress=Vectree())
ORDER = ("pretrain", "plan", "tune", "mesh", "compress")
CHANGES = {
    "about": ({"about": "in other words"}, ""),
    "mesher": ({"mesh": TSDF(voxel=0.5)}, "mesh"),
    "compressor": ({"compress": Vectree(codes=16)}, "compress"),
    "prune": ({"tune": replace(FULL.tune, prune=(PruneByImportance(at=(5,), ratio=0.5),))}, "tune mesh compress"),
    "trim": ({"tune": replace(FULL.tune, prune=(Trim(ratio=0.1),))}, "tune mesh compress"),
    "context": ({"context": "frozen"}, "tune mesh compress"),
    "min_views": ({"min_views": 7}, "plan tune mesh compress"),
    "seed": ({"seed": 5}, "pretrain plan tune mesh compress"),
    "steps": ({"pretrain": replace(FULL.pretrain, steps=7_000)}, "pretrain plan tune mesh compress"),
    "order": (
        {"pretrain": replace(FULL.pretrain, losses=dict(reversed(FULL.pretrain.losses.items())))},
        "pretrain plan tune mesh compress",
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_counts_from_the_part_that_it_belongs_to(name):
    change, others = CHANGES[name]
    before, after = part_keys(FULL), part_keys(replace(FULL, **change))
    assert tuple(before) == tuple(after) == ORDER
    assert " ".join(part for part in ORDER if before[part] != after[part]) == others


def test_every_field_of_a_recipe_belongs_to_a_part():
    """A field that is added later must not be forgotten: it belongs to the first part where nothing else is said."""
    named = {*shared.PLAN_FIELDS, *shared.TUNE_FIELDS, *shared.OTHER_FIELDS}
    assert named <= {each.name for each in fields(Recipe)}
    seen = {name for part in shared.parts(FULL) for name in (part.settings if isinstance(part.settings, dict) else ())}
    assert {each.name for each in fields(Recipe)} - set(shared.OTHER_FIELDS) <= seen


def test_numbers_from_a_file_are_the_same_numbers():
    losses = FULL.pretrain.losses | {"depth": DepthRegression(start=10, end=1)}
    floats = FULL.pretrain.losses | {"depth": DepthRegression(start=10.0, end=1.0)}
    one, other = (replace(FULL, pretrain=replace(FULL.pretrain, losses=each)) for each in (losses, floats))
    assert part_keys(one) == part_keys(other)


def test_inputs_count(data, recipe, tmp_path, monkeypatch):
    prints = fingerprint(read(data))

    def keys(now=data, backend="cpu", known=prints):
        return part_keys(recipe, inputs_of(Run(tmp_path, recipe, now), backend, known))

    first, photographs = keys(), dict(prints.photographs)
    name = next(iter(photographs))
    photographs[name] = replace(photographs[name], content="other")
    others = [
        keys(replace(data, scale=2.0)),
        keys(backend="cuda"),
        keys(known=replace(prints, points="other")),
        keys(known=replace(prints, photographs=photographs)),
    ]
    photographs[name] = replace(prints.photographs[name], time_ns=1)
    assert keys(known=replace(prints, photographs=photographs)) == first, "when a file was written does not count"
    newer = [replace(plugin, version="99") for plugin in shared.records()]
    monkeypatch.setattr(shared, "records", lambda: newer)
    others.append(keys())
    assert len({keys["pretrain"] for keys in (first, *others)}) == 6


@pytest.fixture
def began():
    """The stages that were begun, with the blocks."""
    with listening(
        StageBegan, lambda event: event.stage if event.block is None else f"{event.stage} {event.block}"
    ) as stages:
        yield stages


def test_a_second_run_takes_what_the_first_has_made(data, recipe, undisturbed, tmp_path, began, capsys):
    store = StageCache(tmp_path / "stages")
    first = run(recipe, data, tmp_path / "a", Compute("cpu"), EVERY, store=store)
    assert began == ["pretrain", "tune 0", "tune 1"]
    began.clear()
    capsys.readouterr()
    second = run(replace(recipe, about="again"), data, tmp_path / "b", Compute("cpu"), EVERY, store=store)
    assert began == [] and same(tmp_path / "a", tmp_path / "b") and same(tmp_path / "b", undisturbed)
    told = [line for line in capsys.readouterr().err.splitlines() if "taken from" in line]
    assert told == [f"{tmp_path / 'b'}: taken from {store.folder}, as computed before: pretrain, plan, tune"]
    assert first["images"] == second["images"]
    for name in ("seconds", "cpu_seconds"):
        assert second[name] == first[name], "the cost of a stage comes with it"
    taken = checkpoint.load(tmp_path / "a" / "tune" / "checkpoint.safetensors")
    assert second["peak_memory_bytes"] >= taken.peak_memory_bytes > 0
    steps = [
        [line for line in map(json.loads, (tmp_path / out / "events.jsonl").open()) if line["event"] == "StepDone"]
        for out in "ab"
    ]
    assert len(steps[0]) == recipe.pretrain.steps and steps[0] == steps[1], "so do its curves"
    known = [read_shared(tmp_path / out) for out in "ab"]
    assert {name: each["taken"] for name, each in known[0].items()} == dict.fromkeys(
        ("pretrain", "plan", "tune"), False
    )
    assert all(each["taken"] for each in known[1].values()) and known[0].keys() == known[1].keys()
    notes = [json.loads((tmp_path / out / "run.json").read_text())["notes"] for out in "ab"]
    assert notes[0] == notes[1]


def test_other_blocks_begin_with_the_same_coarse_model(data, recipe, tmp_path, began):
    store = StageCache(tmp_path / "stages")
    other = replace(recipe, tune=replace(recipe.tune, steps=recipe.tune.steps + 1))
    run(recipe, data, tmp_path / "a", Compute("cpu"), EVERY, store=store)
    began.clear()
    run(other, data, tmp_path / "b", Compute("cpu"), EVERY, store=store)
    assert began == ["tune 0", "tune 1"]
    run(other, data, tmp_path / "c", Compute("cpu"), EVERY)
    assert same(tmp_path / "b", tmp_path / "c") and not same(tmp_path / "a", tmp_path / "b")


def test_a_run_that_was_interrupted_goes_on_with_what_another_has_finished(data, recipe, undisturbed, tmp_path, began):
    from two_blocks import stop_after

    from surfkit.runs import run_stage as stage

    store = StageCache(tmp_path / "stages")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("surfkit.runs.pipeline.optimise", stop_after(stage.optimise, 6))
        run(recipe, data, tmp_path / "a", Compute("cpu"), EVERY, store=store)
    assert not store.folder.exists()
    run(recipe, data, tmp_path / "b", Compute("cpu"), EVERY, store=store)
    began.clear()
    run(recipe, data, tmp_path / "a", Compute("cpu"), EVERY, store=store)
    assert began == [] and same(tmp_path / "a", undisturbed)


def test_a_damaged_stage_is_computed_again(data, recipe, undisturbed, tmp_path, began):
    store = StageCache(tmp_path / "stages")
    run(recipe, data, tmp_path / "a", Compute("cpu"), EVERY, store=store)
    for path in store.folder.glob("*/tune/checkpoint.safetensors"):
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    began.clear()
    run(recipe, data, tmp_path / "b", Compute("cpu"), EVERY, store=store)
    assert began == ["tune 0", "tune 1"] and same(tmp_path / "b", undisturbed)


def test_blocks_that_were_reduced_are_not_shared(data, recipe, tmp_path, monkeypatch):
    store = StageCache(tmp_path / "stages")
    state = replace(shared.read_state(tmp_path), reduced=("fewer points",))
    monkeypatch.setattr(shared, "read_state", lambda folder: state)
    run(recipe, data, tmp_path / "a", Compute("cpu"), EVERY, store=store)
    assert read_shared(tmp_path / "a").keys() == {"pretrain", "plan"}
    assert not list(store.folder.glob("*/tune"))
