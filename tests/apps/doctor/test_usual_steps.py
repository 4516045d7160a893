"""How long a run is that nobody gives a length."""

import json
from types import SimpleNamespace

import pytest

from surfkit.apps.doctor import default_steps as length
from surfkit.apps.run_summary import what_next
from surfkit.cli.recipes import ARGV
from surfkit.core.codec import dump
from surfkit.io.datasets.data import Data
from surfkit.runs.folder import Run
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.study.recipes.surface_recipes import SURFACE, SURFACE_SHORT

WHOLE = 30_000


@pytest.fixture
def usual(tmp_path, monkeypatch):
    """The recipe for a number of photographs, words and a device, and what was said."""

    def ask(recipe, photographs=87, words=("recipe:surface",), out=None):
        monkeypatch.setattr(length, "gather", lambda _data: SimpleNamespace(train=range(photographs)))
        token = ARGV.set(tuple(words))
        try:
            return length.with_usual_steps(recipe, Data(tmp_path), "cpu", out)
        finally:
            ARGV.reset(token)

    return ask


@pytest.mark.parametrize(
    ("photographs", "steps"), [(3, 1_000), (34, 1_020), (87, 2_610), (999, 29_970), (5_000, WHOLE)]
)
def test_what_begins_at_stereo_depth_is_as_long_as_its_photographs_ask(usual, photographs, steps, capsys):
    for recipe in (SURFACE, SURFACE_SHORT):
        assert usual(recipe, photographs) == with_steps(recipe, steps)
    assert f"{steps:,}" in (said := capsys.readouterr().err) and "--steps" in said


def test_on_a_gpu_it_is_longer(usual, monkeypatch):
    monkeypatch.setattr(length, "torch_device", lambda _device: SimpleNamespace(type="cuda"))
    assert usual(SURFACE, 87).pretrain.steps == 4 * 2_610 and usual(SURFACE, 3).pretrain.steps == 4_000


@pytest.mark.parametrize(
    "words", [("--pretrain.steps", "9"), ("--pretrain.steps=9",), ("recipe:mine.json",), ("--tune.steps", "4")]
)
def test_a_length_that_is_given_stays(usual, words):
    assert usual(SURFACE, words=(*words, "recipe:surface")) == SURFACE


def test_recipes_that_begin_at_sparse_points_stay(usual):
    assert usual(Recipe()) == Recipe() and usual(SURFACE, photographs=0) == SURFACE


@pytest.mark.parametrize(("before", "after"), [(500, 2_610), (7_000, 7_000), (WHOLE, WHOLE)])
def test_a_run_goes_on_and_is_never_made_shorter(usual, tmp_path, before, after):
    (tmp_path / "recipe.json").write_text(json.dumps(dump(with_steps(SURFACE, before))))
    assert usual(SURFACE, out=tmp_path) == with_steps(SURFACE, after)


def test_what_to_do_next_after_training(tmp_path):
    run = Run(tmp_path / "a run", SURFACE, Data(tmp_path))
    run.out.mkdir()
    assert f"surfkit mesh '{run.out}' mesh:tsdf" in what_next(run) and "compress" not in what_next(run)
    run.mesh_record.write_text("{}")
    run.cloud.write_text("")
    said = what_next(run)
    for command in ("view", "maps", "compress"):
        assert f"`surfkit {command} '{run.out}'`" in said
    assert "\n" not in said
