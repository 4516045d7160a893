"""`surfkit prepare depth`, from photographs to a run that uses what it made."""

import json

import numpy as np
import pytest
import torch
from needs import needs_native
from PIL import Image

from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.core.lock import LOCK_FILE, locked
from surfkit.core.tree import evolve
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import map_path
from surfkit.losses import DepthRegression
from surfkit.runs import run_stage as stage
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.testing.synthetic import Flight, photograph, write_colmap

SMALL = ("estimator:plane-sweep", "--test-every", "4", "--estimator.longest", "48")


@pytest.fixture
def farm(tmp_path):
    """A data set with tracks, of eight photographs; two are held out."""
    torch.set_num_threads(2)
    folder = tmp_path / "farm"
    write_colmap(folder, photograph(Flight(kind="grid", views=8, width=64, height=48, points=300)), tracks=True)
    return folder


def maps(folder):
    return {path.name: path.read_bytes() for path in sorted((folder / "estimated_depths").glob("*.npy"))}


def test_from_photographs_to_a_run_with_priors(farm, tmp_path, capsys):
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    out = capsys.readouterr().out
    assert out.split("\n")[1].split()[0] == "6" and "overview.png" in out
    made = maps(farm)
    assert len(made) == 12 and "view_000.png.npy" not in made  # held out
    record = json.loads((farm / "estimated_depths/depth.json").read_text())
    assert record["aligned"] is True and record["estimator"]["use"] == "plane-sweep" and len(record["matched"]) == 6
    assert not (farm / "estimated_depths/.work").exists()
    with Image.open(farm / "estimated_depths/overview.png") as picture:
        assert picture.size == (3 * 48, 4 * 36) and np.asarray(picture).std() > 20

    recipe = with_steps(evolve(recipes()["2dgs"], "primitive.sh_degree", 0), 60)
    losses = recipe.pretrain.losses | {"depth": DepthRegression()}
    seen = []
    step = stage.Trainer.step

    def watched(self, state):
        done = step(self, state)
        seen.append(done.losses["depth"])
        return done

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage.Trainer, "step", watched)
        run(evolve(recipe, "pretrain.losses", losses), Data(farm, test_every=4), tmp_path / "run")
    assert len(seen) == 60 and max(seen) > 0  # as soon as rays get opaque
    assert json.loads((tmp_path / "run/run.json").read_text())["notes"] == []


def test_one_process_at_a_time_and_what_a_killed_one_left_half_written_goes(farm, capsys):
    left = farm / "estimated_depths/.surfkit-view_001.png.npy.1.part"
    with locked(left.parent):
        left.touch()
        assert main(["prepare", "depth", str(farm), *SMALL]) == 2
        assert "works in it; wait for its end" in capsys.readouterr().err
        assert left.exists() and not maps(farm), "it may be what the other one writes"
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    assert not left.exists() and not (left.parent / LOCK_FILE).exists() and len(maps(farm)) == 12


def test_an_interrupted_estimate_goes_on_to_the_same_maps(farm, monkeypatch, capsys):
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    whole = maps(farm)
    estimate = PlaneSweep.estimate

    def interrupted(self, given, wanted):
        for count, found in enumerate(estimate(self, given, wanted)):
            if count == 2:
                raise KeyboardInterrupt
            yield found

    with monkeypatch.context() as patch:
        patch.setattr(PlaneSweep, "estimate", interrupted)
        assert main(["prepare", "depth", str(farm), *SMALL, "--again"]) == 130
    assert len(maps(farm)) == 4 and all(".png." in name for name in maps(farm))
    capsys.readouterr()
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    assert "2 of 6 photographs have depth maps already" in capsys.readouterr().err
    assert maps(farm) == whole


def damage(farm, *numbers):
    """Cut photographs short; what they were, by path."""
    whole = {path: path.read_bytes() for path in (farm / f"images/view_{at:03d}.png" for at in numbers)}
    for path, content in whole.items():
        path.write_bytes(content[: len(content) // 2])
    return whole


def test_a_damaged_photograph_is_passed_over_until_it_is_whole(farm, capsys):
    for path, content in damage(farm, 3).items():
        assert main(["prepare", "depth", str(farm), *SMALL]) == 0
        said, before = capsys.readouterr(), maps(farm)
        assert said.err.count("note: no depth map is made of a damaged photograph: ") == said.err.count(str(path)) == 1
        assert said.out.split("\n")[1].split()[0] == "5" and len(before) == 10 and "view_003.png.npy" not in before
        path.write_bytes(content)
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    assert "5 of 6 photographs have depth maps already" in capsys.readouterr().err
    assert len(maps(farm)) == 12 and maps(farm).items() >= before.items()
    damage(farm, *range(8))
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0, "there is nothing left to do"


def test_damaged_photographs_alone_are_one_line_and_no_map_is_lost(farm, capsys):
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    before = maps(farm)
    capsys.readouterr()
    damage(farm, *range(8))
    assert main(["prepare", "depth", str(farm), *SMALL, "--again"]) == 2
    notes = capsys.readouterr().err.splitlines()
    assert notes.pop().startswith("surfkit: none of the 6 photographs can be read, ")
    assert len([line for line in notes if line.startswith("note: no depth map is made of a damaged")]) == 6
    assert maps(farm) == before


@needs_native
def test_an_estimate_goes_on_though_a_photograph_was_damaged_meanwhile(farm, monkeypatch, capsys):
    """Also the state of photographs that are not estimated yet was made with the damaged one."""
    words = ["prepare", "depth", str(farm), "--test-every", "4", "--estimator.passes", "1"]
    estimate = PatchMatch.estimate

    def interrupted(self, given, wanted):
        yield next(estimate(self, given, wanted))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(PatchMatch, "estimate", interrupted)
        assert main(words) == 130
    first = maps(farm)
    assert "matching photographs  6/6" in capsys.readouterr().err, "the first map comes after most of the work"
    assert len(first) == 3 and list((farm / "estimated_depths/.work").rglob("*.planes"))
    damage(farm, 3)
    assert main(words) == 0
    assert len(maps(farm)) == 3 * 5 and maps(farm).items() >= first.items()


def test_maps_of_others_are_not_overwritten(farm, capsys):
    path = map_path(farm, "view_001.png")
    path.parent.mkdir()
    np.save(path, np.ones((3, 4)))
    assert main(["prepare", "depth", str(farm), *SMALL]) == 2
    assert "made by another program; --again replaces them" in capsys.readouterr().err
    assert np.load(path).shape == (3, 4)
    assert main(["prepare", "depth", str(farm), *SMALL, "--again"]) == 0
    assert np.load(path).shape == (36, 48)
    assert main(["prepare", "depth", str(farm), *SMALL, "--estimator.window", "7"]) == 2
    assert "made with other settings" in capsys.readouterr().err
    assert main(["prepare", "depth", str(farm), *SMALL, "--scale", "2"]) == 2
    assert "or of other sizes; --again" in capsys.readouterr().err
    record = path.with_name("depth.json")
    whole = json.loads(record.read_text())
    record.write_text(json.dumps({key: value for key, value in whole.items() if key != "made_from"}))
    assert main(["prepare", "depth", str(farm), *SMALL]) == 2
    assert "of which cameras; --again" in capsys.readouterr().err
    record.write_text(json.dumps({key: value for key, value in whole.items() if key != "photographs"}))
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0, "of before contents were noted"
    assert json.loads(record.read_text()) == whole
    record.write_text(json.dumps({key: value for key, value in whole.items() if key != "photographs"}))
    photo = farm / "images" / "view_001.png"
    picture = photo.read_bytes()
    photo.write_bytes(picture[:400])
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    photo.write_bytes(picture)
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0, "what was damaged is not what maps were made from"
    assert json.loads(record.read_text()) == whole
    record.write_text(json.dumps(whole | {"surfkit": "0.0.1"}))
    assert main(["prepare", "depth", str(farm), *SMALL]) == 2
    assert "made by surfkit 0.0.1; --again" in capsys.readouterr().err


def test_maps_of_photographs_that_were_replaced_are_refused(farm, capsys):
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    first, photo = maps(farm), farm / "images" / "view_001.png"
    with Image.open(photo) as picture:
        turned = picture.rotate(180)
    turned.save(photo)
    assert main(["prepare", "depth", str(farm), *SMALL]) == 2
    told = capsys.readouterr().err
    assert "made before 'view_001.png' was changed" in told
    assert maps(farm) == first
    assert main(["prepare", "depth", str(farm), *SMALL, "--again"]) == 0
    assert maps(farm)["view_001.png.npy"] != first["view_001.png.npy"]
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0


def test_masks_change_nothing(farm):
    """Estimators do not look at them."""
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    first = maps(farm)
    for path in (farm / "images").glob("*.png"):
        (farm / "masks").mkdir(exist_ok=True)
        with Image.open(path) as picture:
            Image.new("L", picture.size, 255).save(farm / "masks" / path.name)
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0 and maps(farm) == first


def test_an_estimate_that_was_refused_keeps_nobody_from_another(farm, tmp_path, capsys):
    wrong = tmp_path / "wrong" / "estimated_depths"
    wrong.mkdir(parents=True)
    for index in range(8):
        np.save(wrong / f"view_{index:03}.png.npy", np.full((48, 64), 3.0))
    fill = ("estimator:filled", "estimator.fill:monocular", "--estimator.fill.maps", str(wrong.parent))
    assert main(["prepare", "depth", str(farm), "--test-every", "4", *fill]) == 2
    assert "no map can be used: constant" in capsys.readouterr().err
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0 and len(maps(farm)) == 12


def test_a_record_without_maps_keeps_nobody_from_making_some(farm):
    """What is left where `--again` was killed after it had deleted the maps."""
    assert main(["prepare", "depth", str(farm), *SMALL]) == 0
    first = maps(farm)
    for path in (farm / "estimated_depths").glob("*.npy"):
        path.unlink()
    record = farm / "estimated_depths" / "depth.json"
    whole = json.loads(record.read_text())
    for other in ({"surfkit": "0.0.1"}, {"photographs": whole["photographs"] | {"view_001.png": "0"}}):
        for path in (farm / "estimated_depths").glob("*.npy"):
            path.unlink()
        record.write_text(json.dumps(whole | other))
        assert main(["prepare", "depth", str(farm), *SMALL]) == 0 and maps(farm) == first
        assert json.loads(record.read_text()) == whole, "what the maps are made from now"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["prepare", "photo"],
            "prepare has no 'photo'; did you mean 'photos'? usage: surfkit prepare photos|points|depth",
        ),
        (["prepare", "depth", "nowhere"], "nowhere: no such folder"),
        (["prepare", "depth", "d", "estimator:plan-sweep"], "did you mean 'plane-sweep'?"),
        (["prepare", "depth", "d", "--estimator.window", "4"], "window is 4; it must be an odd number"),
    ],
)
def test_mistakes_are_one_line(words, message, capsys):
    assert main(words) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1


def test_a_model_without_tracks_is_one_line(tmp_path, capsys):
    write_colmap(tmp_path, photograph(Flight(views=4, width=24, height=18, points=40)))
    assert main(["prepare", "depth", str(tmp_path)]) == 2
    assert "observes any point" in capsys.readouterr().err
    assert not (tmp_path / "estimated_depths").exists()


def test_help_names_what_can_be_prepared(capsys):
    assert main(["prepare"]) == main(["prepare", "--help"]) == 0
    assert "surfkit prepare photos" in capsys.readouterr().out
    assert main(["prepare", "depth", "estimator:depth-anything-v2", "--help"]) == 0
    assert "CC BY-NC 4.0" in capsys.readouterr().out
