"""`surfkit ablate`, with real runs of a few steps."""

import json
import os
import re
import signal

import pytest
import torch

from surfkit.cli import main
from surfkit.core import registry
from surfkit.runs import pipeline
from surfkit.runs import run_stage as stage
from surfkit.study.recipes.ablations import TABLES
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    torch.set_num_threads(2)
    folder = tmp_path_factory.mktemp("data") / "tiny"
    write_colmap(folder, photograph(Flight(views=9, width=32, height=24, points=60)))
    return folder


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--data", "d"], "d: no such folder; "),
        (["--data", "d", "--columns", "pnsr"], "--columns: no column named 'pnsr'; did you mean 'psnr'? known: ssim, "),
        (["--data", "d", "--columns", "f1", "f1"], "--columns: f1 is there twice; name each column once"),
        (["mine.json", "--data", "d"], "mine.json: no such file"),
        (
            ["table:modle", "--data", "d"],
            "no table named 'modle'; did you mean 'model'? known: model, gradient, surface, methods, trim, partition",
        ),
        (["table:model", "table:gradient", "--data", "d"], "table is chosen twice: table:model, table:gradient; keep"),
        (["table:model"], "--data [PATH [PATH ...]] missing; see surfkit ablate --help"),
        (
            ["table:model", "--data", "d", "--rows", "DGD"],
            "--rows: no row named 'DGD'; did you mean '+ DGD'? ",
        ),
        (["table:model", "--data", "d", "--seeds", "0"], "--seeds 0: give 1 or more"),
        (["table:model", "--data", "d", "--steps", "0"], "--steps 0: give 1 to 100000000"),
        (["table:model", "--data", "d", "--tau", "1"], "--tau 1: it needs --gt; add --gt, or leave it out"),
        (
            ["table:model", "--data", "d", "--gt", "t", "--tau", "0"],
            "--tau 0: it is a length, so it must be more than 0",
        ),
        (["table:model", "--data", "d"], "d: no such folder; "),
        (["table:model", "--data", "d", "--scale", "0.5"], "--scale 0.5: it divides the size"),
    ],
)
def test_what_users_get_wrong_is_one_line(monkeypatch, tmp_path, capsys, words, line):
    monkeypatch.chdir(tmp_path)
    assert main(["ablate", *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"surfkit: {line}") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["--data", "d"], ["--data", "d", "table:model"], ["--help"]])
def test_without_any_table_it_is_one_line(monkeypatch, capsys, words):
    monkeypatch.setenv("SURFKIT_PLUGINS", "none")
    monkeypatch.setattr(
        registry, "BUILTIN", tuple(name for name in registry.BUILTIN if name != "surfkit.study.recipes")
    )
    registry.reload()
    try:
        assert main(["ablate", *words]) == 2
    finally:
        monkeypatch.undo()
        registry.reload()
    said = capsys.readouterr().err
    assert said.startswith("surfkit: no plugin in use offers an ablation table") and said.count("\n") == 1


def test_help(capsys):
    assert main(["ablate", "--help"]) == 0
    out = capsys.readouterr().out
    for name, table in TABLES.items():
        assert re.search(rf"table:{name}[ │\n]+{' '.join(table.about.split()[:3])}", out)
    for flag in ("--data", "--steps", "--seeds", "--rows", "--scale", "--longest", "--test-every", "--images", "--out"):
        assert flag in out


def test_a_real_table_interrupted_and_continued(scene, monkeypatch, tmp_path, capsys, forked_probe):
    monkeypatch.chdir(tmp_path)
    command = ["ablate", "table:gradient", "--data", str(scene), "--steps", "4", "--rows", "1", "SSIM"]
    stop = ["--out", "stopped"]

    class Interrupting(stage.TrainingDisplay):
        def show(self, done):
            if done.index == 2:
                os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(stage, "TrainingDisplay", Interrupting)
        assert main([*command, *stop]) == 130
    said = capsys.readouterr().err
    assert "stopped after step 2 of 4" in said and "stopped keeps what is finished; give the same command again" in said
    command += ["--probe", "0"]
    assert main([*command, *stop]) == 0
    assert "going on after step 2 of 4" in capsys.readouterr().err
    assert main(command) == 0
    captured = capsys.readouterr()
    assert re.search(r"^1 +SSIM \+ RGB \+ normal +1/1 +0\.\d{3} +\d+\.\d\d ", captured.out, re.M)
    assert "runs/tiny-ablate-gradient/ablation.md" in captured.out
    found = [
        json.loads((tmp_path / out / "ablation.json").read_text()) for out in ("stopped", "runs/tiny-ablate-gradient")
    ]
    rows = [report["data_sets"][0]["rows"] for report in found]
    for each in rows:
        assert [len(row["runs"]) for row in each[:4]] == [1, 0, 0, 1]
    for name in ("psnr", "ssim", "points"):
        assert len({json.dumps([row["mean"].get(name) for row in each]) for each in rows}) == 1
    assert rows[0][3]["difference"]["psnr"]["seeds"] == 1


@pytest.mark.parametrize("workers", [(), ("executor:pool", "--executor.workers", "1")], ids=["here", "elsewhere"])
def test_checkpoints_as_often_as_asked(scene, tmp_path, workers):
    words = ["table:gradient", "--data", str(scene), "--steps", "4", "--rows", "1", "--out", str(tmp_path)]
    assert main(["ablate", *words, "--probe", "0", "--checkpoint-every", "3", *workers]) == 0
    (run,) = (tmp_path / "runs").iterdir()
    lines = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    step, saved = 0, []
    for line in lines:
        step = line["index"] if line["event"] == "StepDone" else step
        saved += [step] if line.get("what") == "checkpoint" else []
    assert saved == [3, 4]


def test_checkpoints_without_steps_between_are_refused(scene, tmp_path, capsys):
    assert main(["ablate", "--data", str(scene), "--out", str(tmp_path / "t"), "--checkpoint-every", "0"]) == 2
    assert "--checkpoint-every 0: give 1 or more steps" in capsys.readouterr().err


def test_a_failing_row_is_exit_status_1(scene, monkeypatch, tmp_path, capsys):
    real = pipeline.run

    def run(recipe, *rest, **more):
        if recipe.pretrain.signal.terms is None:
            raise MemoryError("out of memory")
        return real(recipe, *rest, **more)

    monkeypatch.setattr(pipeline, "run", run)
    words = ["table:gradient", "--data", str(scene), "--steps", "2", "--rows", "1", "4", "--out", str(tmp_path)]
    assert main(["ablate", *words, "--probe", "0"]) == 1
    captured = capsys.readouterr()
    assert "SSIM + RGB + normal: failed: seed 0: MemoryError" in captured.err
    assert re.search(r"^4 +SSIM +1 +1/1 +\d", captured.out, re.M)


MINE = {
    "name": "mine",
    "base": "3dgs",
    "rows": [{"label": "base", "change": {"primitive.sh_degree": 0}}, {"label": "other", "change": {"seed": 3}}],
}


@pytest.mark.parametrize("word", ["my_table.json", "table:my_table.json", "my_table.py", "my_table.py:mine"])
def test_tables_of_users(scene, monkeypatch, tmp_path, capsys, word):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_table.json").write_text(json.dumps(MINE))
    head = "from surfkit import Row, Table\nfrom surfkit.study.recipes import RECIPES\n"
    rows = "(Row('base', {'primitive.sh_degree': 0}), Row('other', {'seed': 3}))"
    (tmp_path / "my_table.py").write_text(f"{head}TABLE = Table('mine', 'Mine', RECIPES['3dgs'], {rows})\n")
    words = ["--data", str(scene), "--steps", "2", "--device", "cpu", "--columns", "psnr", "bytes"]
    assert main(["ablate", word, *words, "--rows", "1", "--probe", "0"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^ +row +on +seeds +PSNR +size$", shown, re.M)
    assert re.search(r"^1 +base +1/1 +\d+\.\d\d +\d+\.\d\d kB$", shown, re.M)
    folder = tmp_path / "runs" / "tiny-ablate-mine"
    assert {path.name for path in folder.glob("ablation.*")} == {f"ablation.{e}" for e in ("json", "md", "tex", "csv")}
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert main(["ablate", word, *words, "--show"]) == 0
    again = capsys.readouterr().out
    assert again.splitlines()[1] == shown.splitlines()[1] and re.search(r"^2 +other +1 +0/1", again, re.M)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before, "nothing is run or written"


def test_missing_depth_maps_are_told_once_before_the_table(scene, tmp_path, capsys):
    rows = [{"label": "base", "change": {"primitive.sh_degree": 0}}]
    rows += [{"label": f"depth {end}", "change": {"pretrain.losses.depth.end": end}} for end in (0.1, 0.2)]
    (tmp_path / "mine.json").write_text(json.dumps({"name": "mine", "base": "citygs2", "rows": rows}))
    words = [str(tmp_path / "mine.json"), "--data", str(scene), "--steps", "1", "--out", str(tmp_path / "out")]
    assert main(["ablate", *words, "--rows", "2", "--probe", "0"]) == 0
    said = capsys.readouterr().err
    first = said.partition("run 1 of 1:")[0]
    make = f"make them with `surfkit prepare depth {scene}`"
    assert first.startswith(f"note: {scene} has no depth priors") and first.count("\n") == 1
    assert first.endswith(f"depth and normal-prior, in row 2; {make}\n")
    kept = json.loads((tmp_path / "out" / "ablation.json").read_text())["data_sets"][0]["notes"]
    assert [note["rows"] for note in kept if note["text"].endswith(make)] == [["depth 0.1"]]
    page = (tmp_path / "out" / "ablation.md").read_text()
    assert page.count(make) == 1 and f"\n- row 2: {scene} has no depth priors" in page


def test_rows_that_nothing_can_measure_are_named(scene, tmp_path, capsys):
    """Also where no other row is left to run."""
    rows = [{"label": "fused", "change": {"method": {"use": "stereo"}}}]
    (tmp_path / "mine.json").write_text(json.dumps({"name": "mine", "base": "stereo", "rows": rows}))
    words = [str(tmp_path / "mine.json"), "--data", str(scene), "--out", str(tmp_path / "out")]
    assert main(["ablate", *words]) == 0
    said = capsys.readouterr().err
    assert "without --gt" in said and said.endswith(": all rows, fused\n") and said.count("\n") == 1


def test_nothing_is_made_to_show_a_table_without_runs(scene, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["ablate", "--data", str(scene), "--show", "--columns", "psnr", "fps"]) == 0
    shown = capsys.readouterr().out
    assert "paper: PSNR" in shown and re.search(r"^12 +\(\+ partition of 2DGS\) +11 +0/1 +22.68 \(-0.49\)", shown, re.M)
    assert not list(tmp_path.iterdir())


def test_the_tables_and_their_rows(tmp_path, capsys):
    assert main(["tables"]) == 0
    assert re.search(r"^model +14 +What each component brings", capsys.readouterr().out, re.M)
    for name in ("model", "table:model"):
        assert main(["tables", name]) == 0
        shown = capsys.readouterr().out
        assert re.search(
            r'^3 +\+ DGD +2 +pretrain.signal.terms = \["ssim"\]; pretrain.signal.boost = 0.9$', shown, re.M
        )
        assert re.search(r"^6 +\(control: one block\) +5 +partition.blocks.0 = 1; partition.blocks.1 = 1$", shown, re.M)
        assert re.search(r"^13 +CityGaussian +10 +a recipe of its own$", shown, re.M)
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(MINE))
    assert main(["tables", str(path)]) == 0
    assert re.search(r"^2 +other +1 +seed = 3$", capsys.readouterr().out, re.M)
    assert main(["tables", "modle"]) == 2
    assert "no table named 'modle'; did you mean 'model'?" in capsys.readouterr().err
