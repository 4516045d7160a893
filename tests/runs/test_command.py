"""What a user is told to do with a run that was stopped, or is of another recipe."""

import os
import shlex
import signal
from pathlib import Path

import pytest

from surfkit.apps.train import TrainCommand
from surfkit.cli import main
from surfkit.cli.parse import parse
from surfkit.core.registry import offered_once
from surfkit.io.datasets.data import Data, ReadSettings
from surfkit.runs import run_stage as stage
from surfkit.runs.command import train_command
from surfkit.runs.folder import Run, read_data
from surfkit.runs.pipeline import opened
from surfkit.testing.synthetic import Flight, photograph, write_colmap

QUICK = "--steps 4 --pictures-every 0 --scale 1.5 --primitive.sh-degree 0 mesh:none".split()


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    """A run, in a folder whose name has a blank, that was interrupted after two of four steps."""
    write_colmap(tmp_path / "my data", photograph(Flight(views=4, width=32, height=24, points=60)))

    class Interrupting(stage.TrainingDisplay):
        def show(self, done):
            if done.index == 2:
                os.kill(os.getpid(), signal.SIGINT)

    words = ["recipe:2dgs", *QUICK, "--data", str(tmp_path / "my data"), "--out", str(tmp_path / "my run")]
    with monkeypatch.context() as patch:
        patch.setattr(stage, "TrainingDisplay", Interrupting)
        assert main(["train", *words]) == 130
    return tmp_path / "my run"


def test_every_command_names_the_one_that_finishes_the_run(stopped, capsys):
    for words in (["mesh"], ["maps"], ["texture"], ["evaluate"], ["evaluate", "--gt", "x.ply"], ["export"], ["status"]):
        capsys.readouterr()
        assert main([words[0], str(stopped), *words[1:]]) == (3 if words == ["status"] else 2)
        said = capsys.readouterr()
        (command,) = (text for text in (said.err + said.out).split("`") if text.startswith("surfkit "))
        assert shlex.split(command)[1] == "train", said
    assert main(shlex.split(command)[1:]) == 0 and "going on after step 2 of 4" in capsys.readouterr().err
    assert main(["status", str(stopped)]) == 0 and "surfkit train" not in capsys.readouterr().out


def test_the_command_reads_the_data_set_in_the_same_way(stopped):
    given = Data(
        Path("other data"), scale=3.4175, missing="skip", white=True, masks=Path("my masks"), test_every=5,
        test_data=Path("tests"), metres_per_unit=0.1 + 0.2,
    )  # fmt: skip
    run = Run(stopped, opened(stopped).recipe, given)
    found = parse(TrainCommand, shlex.split(train_command(run))[2:], "surfkit train")
    assert found.reading.of(found.data, 5) == given and found.out == stopped and found.recipe == run.recipe
    assert read_data(stopped).scale == 1.5 and ReadSettings().scale is None


def test_another_recipe_is_told_by_its_name(stopped, capsys):
    words = ["train", *QUICK, "--data", str(stopped.parent / "my data"), "--out", str(stopped)]
    assert main([*words, "recipe:surface"]) == 2
    assert "recipe:2dgs, and this one is of recipe:surface" in capsys.readouterr().err
    assert main([*words, "recipe:2dgs", "--seed", "7"]) == 2
    assert "holds a run with seed 0, and this one has 7" in capsys.readouterr().err
    abouts = [recipe.about for recipe in offered_once("surfkit_recipes", "a recipe").values()]
    assert len(set(abouts)) == len(abouts) and all(abouts), "what runs keep of a recipe names it"
