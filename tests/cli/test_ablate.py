"""`surfkit ablate`, with real runs of a few steps."""

import json
import os
import re
import signal

import pytest
import torch

from surfkit import pipeline
from surfkit.cli import main
from surfkit.recipes.ablations import TABLES
from surfkit.run import stage
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
        (["--data", "d"], "no table chosen: add one of table:model, table:gradient, table:surface"),
        (
            ["table:modle", "--data", "d"],
            "no table named 'modle'; did you mean 'model'? known: model, gradient, s",
        ),
        (["table:model", "table:gradient", "--data", "d"], "table is chosen twice: table:model, table:gradient; keep"),
        (["table:model"], "--data PATH missing; see surfkit ablate --help"),
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


def test_help(capsys):
    assert main(["ablate", "--help"]) == 0
    out = capsys.readouterr().out
    for name, table in TABLES.items():
        assert re.search(rf"table:{name} +{' '.join(table.about.split()[:3])}", out)
    for flag in ("--data", "--steps", "--seeds", "--rows", "--scale", "--longest", "--test-every", "--images", "--out"):
        assert flag in out


def test_a_real_table_interrupted_and_continued(scene, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["ablate", "table:gradient", "--data", str(scene), "--steps", "4", "--rows", "1", "SSIM"]
    stop = ["--out", "stopped"]

    class Interrupting(stage.Display):
        def show(self, done):
            if done.index == 2:
                os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(stage, "Display", Interrupting)
        assert main([*command, *stop]) == 130
    said = capsys.readouterr().err
    assert "stopped after step 2 of 4" in said and "stopped keeps what is finished; give the same command again" in said
    assert main([*command, *stop]) == 0
    assert "going on after step 2 of 4" in capsys.readouterr().err
    assert main(command) == 0
    captured = capsys.readouterr()
    assert re.search(r"^1 +SSIM \+ RGB \+ normal +1/1 +\d+\.\d\d ", captured.out, re.M)
    assert "runs/tiny-ablate-gradient/ablation.md" in captured.out
    found = [
        json.loads((tmp_path / out / "ablation.json").read_text()) for out in ("stopped", "runs/tiny-ablate-gradient")
    ]
    for report in found:
        assert [len(row["runs"]) for row in report["rows"][:4]] == [1, 0, 0, 1]
    for name in ("psnr", "ssim", "points"):
        assert len({json.dumps([row["mean"].get(name) for row in report["rows"]]) for report in found}) == 1
    assert found[0]["rows"][3]["difference"]["psnr"]["seeds"] == 1


def test_a_failing_row_is_exit_status_1(scene, monkeypatch, tmp_path, capsys):
    real = pipeline.run

    def run(recipe, *rest):
        if recipe.pretrain.signal.terms is None:
            raise MemoryError("out of memory")
        return real(recipe, *rest)

    monkeypatch.setattr(pipeline, "run", run)
    words = ["table:gradient", "--data", str(scene), "--steps", "2", "--rows", "1", "4", "--out", str(tmp_path)]
    assert main(["ablate", *words]) == 1
    captured = capsys.readouterr()
    assert "surfkit: SSIM + RGB + normal: failed: seed 0: MemoryError: out of memory; see " in captured.err
    assert re.search(r"^4 +SSIM +1/1 +\d", captured.out, re.M)
