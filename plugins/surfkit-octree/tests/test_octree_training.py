"""Anchors in training: they learn, the same bits again and after a stop, and what a run tells of their levels."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import surfkit_octree
import torch
from surfkit_octree import OCTREE, SCAFFOLD, AnchorGrowth
from surfkit_octree.__main__ import main as report
from surfkit_octree.levels import TABLE, LevelTable

from surfkit.cli import main
from surfkit.core.registry import plugins
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.plugin import Densify, LearningRate, Points, components
from surfkit.raster.select import select
from surfkit.runs.recipe import with_steps
from surfkit.scene.photos import photo_cache
from surfkit.start.base import StartInput
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.trainer import Trainer

GROWTH = AnchorGrowth(start=10, until=50, every=10, progressive=20, shown=0.2)


@pytest.fixture(autouse=True, scope="module")
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = AnchorGrowth in components(Densify).values()
    if not there:
        plugins().register(surfkit_octree, "octree of this test")
    yield
    if not there:
        plugins().unregister(surfkit_octree)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("octree")
    write_colmap(folder, photograph(Flight(views=12, width=48, height=36, points=250)))
    return folder


def begun(source, recipe=OCTREE, steps=60, **start):
    """A trainer and its state, as the recipe begins."""
    scene, draw = read(Data(source)), torch.Generator().manual_seed(0)
    rates = recipe.pretrain.rates | {"offsets": LearningRate(0.1)}  # so that they leave their voxels in so few steps
    stage = replace(recipe.pretrain, steps=steps, densify=GROWTH, rates=rates)
    photos = photo_cache(scene.train)
    trainer = Trainer(stage, recipe.primitive, scene.train, photos, select("cpu")[0])
    known = StartInput(scene, photos, None, None, draw)
    model = replace(recipe.start, **start).model(recipe.primitive, known, draw)
    return trainer, trainer.begin(Points.fresh(model.params, recipe.primitive.shared()), draw)


def same(one, two):
    for group in ("params", "exp_avg", "exp_avg_sq", "stats", "shared"):
        for name, value in getattr(one.points, group).items():
            assert torch.equal(value, getattr(two.points, group)[name]), (group, name)


@pytest.mark.parametrize(("recipe", "levels"), [(OCTREE, 3), (SCAFFOLD, 1)], ids=["octree", "scaffold"])
def test_anchors_learn_and_go_on_to_the_same_bits(source, tmp_path, recipe, levels):
    trainer, whole = begun(source, recipe, levels=levels)
    before = {name: value.clone() for name, value in whole.points.all_params().items()}
    done = list(trainer.run(whole))
    first, last = (sum(d.losses["l1"] for d in part) for part in (done[:10], done[-10:]))
    assert last < 0.8 * first
    counts = [each.points for each in done]
    assert len(set(counts)) > 1 and set(torch.tensor(counts).diff().nonzero()[:, 0].tolist()) <= {18, 28, 38, 48}
    assert any(after > before for before, after in zip(counts, counts[1:], strict=False)), "anchors were added"
    params, networks = whole.points.all_params(), [name for name in before if name.split("_")[0] in ("shape", "color")]
    assert LevelTable.of(params[TABLE]).active == levels and len(networks) == 8
    assert all(not torch.equal(params[name], before[name]) for name in networks), "the networks learn"
    known = {tuple(place) for place in before["means"].tolist()}
    kept = sum(tuple(place) in known for place in params["means"].tolist())
    assert kept > len(known) / 2, "positions are not trained"

    trainer, half = begun(source, recipe, levels=levels)
    for _ in range(25):
        trainer.step(half)
    if levels == 3:
        assert LevelTable.of(half.points.shared[TABLE]).active == 3 and half.points.stats
    checkpoint.save(tmp_path / "half.safetensors", half)
    again = checkpoint.load(tmp_path / "half.safetensors")
    for _ in trainer.run(again):
        pass
    same(whole, again)


def test_the_bundled_scene_is_learnt():
    """60 steps of the recipe at an eighth of the size: held-out views come near their photographs."""
    scene = read(Data(Path(__file__).parents[3] / "examples" / "boruszyn", scale=8))
    recipe, draw, photos = with_steps(OCTREE, 60), torch.Generator().manual_seed(0), photo_cache(scene.train)
    trainer = Trainer(recipe.pretrain, recipe.primitive, scene.train, photos, select("cpu")[0])
    model = recipe.start.model(recipe.primitive, StartInput(scene, photos, None, None, draw), draw)
    state = trainer.begin(Points.fresh(model.params, recipe.primitive.shared()), draw)

    def psnr():
        splats, errors = recipe.primitive.activate(state.points.all_params(), 0).detached(), []
        for view, photo in zip(scene.held_out, photo_cache(scene.held_out), strict=True):
            drawn = trainer.draws.render(splats, view.camera, recipe.pretrain.near, False, False).maps.color
            errors.append((drawn.clamp(0, 1) - photo / 255).square().mean())
        return -10 * float(torch.stack(errors).log10().mean())

    before = psnr()
    for _ in trainer.run(state):
        pass
    assert before < 9 and psnr() > before + 3


def test_a_run_has_levels_maps_and_no_ply(source, tmp_path, capsys):
    out = tmp_path / "run"
    words = ["recipe:octree", "primitive:anchors", "--primitive.draws", "surfel", "--start.levels", "2", "mesh:none"]
    assert main(["train", *words, "--data", str(source), "--out", str(out), "--steps", "30"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["images"]["psnr"] > 8 and not (out / "point_cloud.ply").exists()
    notes = json.loads((out / "run.json").read_text())["notes"]
    assert any("no point_cloud.ply" in text and "anchors" in text for text in notes)
    capsys.readouterr()
    assert report([str(out)]) == 0
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()]
    assert rows[0] == ["distance", "local units", "in view", "drawn", "level 0", "level 1"]
    numbers = [[float(value.replace(",", "")) for value in row[1:]] for row in rows[2:]]
    assert [row[0] for row in rows[2:]] == ["1 x", "2 x", "4 x", "8 x", "16 x"]
    drawn = [row[2] for row in numbers]
    assert drawn[0] > drawn[-1] > 0 and numbers[-1][-1] == 0, "from afar level 0 alone is drawn"
    assert [row[0] for row in numbers] == sorted(row[0] for row in numbers)


def test_the_report_refuses_other_runs(tmp_path, capsys):
    assert report([str(tmp_path)]) == 2
    assert "python -m surfkit_octree: " in capsys.readouterr().err
