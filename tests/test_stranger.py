"""A package from outside the repository, found through the entry point that its own pyproject declares: each of its
parts passes its check and is used from the command line, where one word puts it in the place of another."""

import ast
import json
import os
import re
import shutil
import signal
from pathlib import Path

import pytest
import tomllib
import torch

from surfkit.cli import main
from surfkit.core import registry
from surfkit.core.registry import components
from surfkit.densify.base import Densify, Prune, Signal
from surfkit.io.splats.ply import read_splats
from surfkit.losses.base import Loss
from surfkit.mesh.base import Mesher
from surfkit.primitives.base import Primitive
from surfkit.runs import run_stage as stage
from surfkit.testing import check
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.optimizer import Optimizer

SOURCE = Path(__file__).parent / "stranger"
WORDS = {
    "far": "pretrain.prune.0:far",
    "charbonnier": "pretrain.losses.l1:charbonnier",
    "top-share": "pretrain.densify:top-share",
    "cards": "mesh:cards",
    "balls": "primitive:balls",
    "blend": "pretrain.signal:blend",
    "steady": "pretrain.optimizer:steady",
}
KINDS = {"far": Prune, "charbonnier": Loss, "top-share": Densify, "cards": Mesher, "balls": Primitive}
KINDS |= {"blend": Signal, "steady": Optimizer}


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory):
    """The package in a folder of its own, with the files that pip writes of it; no other plugin is in use."""
    site = tmp_path_factory.mktemp("site")
    shutil.copytree(SOURCE / "acme_surfkit", site / "acme_surfkit", ignore=shutil.ignore_patterns("__pycache__"))
    project = tomllib.loads((SOURCE / "pyproject.toml").read_text())["project"]
    info = site / f"acme_surfkit-{project['version']}.dist-info"
    info.mkdir()
    name, version = project["name"], project["version"]
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    points = [f"{key} = {value}\n" for key, value in project["entry-points"]["surfkit"].items()]
    (info / "entry_points.txt").write_text("[surfkit]\n" + "".join(points))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        patch.setenv("SURFKIT_PLUGINS", "acme")
        registry.reload()
        yield site
    registry.reload()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_colmap(folder, photograph(Flight(views=8, width=32, height=24, points=120)))
    return folder


@pytest.fixture(scope="module")
def train(data):
    """A function that trains with some words, and returns the exit status."""

    def run(out, *words, steps=6, status=0):
        where = ["--data", str(data), "--out", str(out), "--steps", str(steps), "--pictures-every", "0"]
        assert main(["train", "recipe:2dgs", "--primitive.sh-degree", "1", *where, *words]) == status
        return out

    return run


@pytest.fixture(scope="module")
def finished(train, tmp_path_factory):
    """A run with all of the parts."""
    return train(tmp_path_factory.mktemp("runs") / "all", *WORDS.values())


def state_of(out):
    return checkpoint.load_last(out / "pretrain" / "checkpoint.safetensors")[0]


def recipe_of(out):
    return json.loads((out / "recipe.json").read_text())


def test_it_needs_nothing_but_surfkit_itself():
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [node.module] if isinstance(node, ast.ImportFrom) else []
            more = [m for m in modules if m.startswith("surfkit.") and m != "surfkit.plugin"]
            assert not more, f"{path.name} imports more than `surfkit.plugin`"


@pytest.mark.parametrize("name", KINDS)
def test_the_check_of_its_kind(name):
    check(components(KINDS[name])[name]())


def test_the_parts_are_listed_with_where_they_come_from(capsys):
    assert main(["components"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, kind in KINDS.items():
        line = next(line for line in lines if line.split()[:2] == [kind.__name__.lower(), name])
        assert line.split()[-1] == "acme-surfkit"
    assert main(["plugins"]) == 0
    offers = "far, charbonnier, top-share, cards, balls, blend, steady, recipe:acme, table:acme, command extent"
    assert re.search(f"acme +acme-surfkit +1.2 +{offers}", capsys.readouterr().out)


def test_a_run_of_all_of_them(finished):
    recipe, state = recipe_of(finished)["pretrain"], state_of(finished)
    assert [part["use"] for part in (recipe["prune"][0], recipe["losses"]["l1"], recipe["densify"])] == list(WORDS)[:3]
    assert len(state.points) > 120, "points were added"
    lines = map(json.loads, (finished / "events.jsonl").read_text().splitlines())
    losses = [line["losses"] for line in lines if line["event"] == "StepDone"]
    assert len(losses) == 6 and all(set(terms) >= {"l1", "ssim"} for terms in losses)


def test_an_interrupted_run_comes_to_the_same(train, finished, tmp_path, monkeypatch):
    """Stopped after three steps, between two edits: what the densifier has summed up is kept."""

    class Interrupting(stage.TrainingDisplay):
        def show(self, done):
            if done.index == 3:
                os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(stage, "TrainingDisplay", Interrupting)
        train(tmp_path / "run", *WORDS.values(), status=130)
    assert state_of(tmp_path / "run").index == 3
    resumed, whole = state_of(train(tmp_path / "run", *WORDS.values())), state_of(finished)
    for name in ("params", "exp_avg", "exp_avg_sq", "stats"):
        for key, value in getattr(whole.points, name).items():
            assert torch.equal(value, getattr(resumed.points, name)[key]), f"{name} {key}"
    assert "acme/grad" in whole.points.stats


def test_the_command(finished, capsys):
    assert main(["extent", str(finished)]) == 0
    low, high = (tuple(map(float, line.split())) for line in capsys.readouterr().out.splitlines()[-2:])
    means = read_splats(finished / "point_cloud.ply").means
    assert low == pytest.approx(means.amin(0).tolist(), abs=1e-3)
    assert high == pytest.approx(means.amax(0).tolist(), abs=1e-3)
    assert main(["extent", "nowhere"]) == 2 and capsys.readouterr().err.count("\n") == 1


def test_export_and_measures(finished, tmp_path):
    assert main(["export", str(finished), "--out", str(tmp_path / "points.ply")]) == 0
    assert len(read_splats(tmp_path / "points.ply").means) == len(state_of(finished).points)
    assert main(["evaluate", str(finished)]) == 0
    assert json.loads((finished / "metrics.json").read_text())["images"]["psnr"] > 5


def test_the_mesh_and_its_facts(finished):
    assert main(["mesh", str(finished), "mesh:cards", "--mesh.size", "0.02", "--least-triangles", "1"]) == 0
    record, count = json.loads((finished / "mesh.json").read_text()), len(state_of(finished).points)
    assert record["mesher"] == {"use": "cards", "size": 0.02}
    told = json.dumps(record)
    assert f'"cards": {count}' in told and '"facing": "the nearest camera"' in told and '"texture": null' in told


@pytest.mark.parametrize("name", WORDS)
def test_one_word_puts_a_part_in_the_place_of_another(train, tmp_path, name):
    """Each of them alone, among the built-in ones."""
    out = train(tmp_path / name, WORDS[name], *([] if name == "cards" else ["mesh:none"]), steps=2)
    assert f'"use": "{name}"' in (out / "recipe.json").read_text()
    assert (out / "mesh.json").exists() == (name == "cards")


def test_an_ablation_table_of_them_and_its_report(data, tmp_path, capsys):
    words = ["--data", str(data), "--steps", "4", "--out", str(tmp_path), "--probe", "0"]
    rows = ["+ top share", "+ cards", "+ blend", "+ steady", "recipe of Acme"]
    assert main(["ablate", "table:acme", *words, "--rows", "1", *rows, "--max-points", "130"]) == 0
    printed = capsys.readouterr().out
    assert all(row in printed for row in rows)
    assert main(["report", str(tmp_path)]) == 0
    results, page = (tmp_path / "ablation.json").read_text(), (tmp_path / "report.html").read_text()
    assert all(row in results and row in page for row in rows)


def test_help_and_lists_show_them(capsys):
    shown = {}
    for words in (["train", "--help"], ["train", "recipe:2dgs", "--help"], ["recipes"], ["tables"], ["tables", "acme"]):
        assert main(words) == 0
        shown[" ".join(words)] = capsys.readouterr().out
    assert "recipe:acme" in shown["train --help"] and "acme" in shown["recipes"] and "acme" in shown["tables"]
    for word in ("primitive:balls", "pretrain.densify:top-share", "mesh:cards"):
        assert word in shown["train recipe:2dgs --help"]
    assert "recipe of Acme" in shown["tables acme"]


def test_the_recipe_is_trained_by_its_name(data, tmp_path):
    words = ["--data", str(data), "--out", str(tmp_path), "--steps", "4", "--pictures-every", "0"]
    assert main(["train", "recipe:acme", *words]) == 0
    assert recipe_of(tmp_path)["primitive"]["use"] == "balls"
    assert recipe_of(tmp_path)["pretrain"]["prune"][0]["use"] == "far"
    assert state_of(tmp_path).points.params["scales"].shape[1:] == (1,)


def test_what_is_refused_is_one_line(train, tmp_path, capsys):
    train(tmp_path / "run", WORDS["far"], "--pretrain.prune.0.radius", "0", status=2)
    assert "far.radius 0, every 2: give more than 0, and 1 or more" in capsys.readouterr().err
    train(tmp_path / "run", "pretrain.prune.0:fra", status=2)
    assert "did you mean" in (said := capsys.readouterr().err) and "far" in said
