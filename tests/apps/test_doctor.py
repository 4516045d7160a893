"""`surfkit doctor` at the command line."""

import json

import pytest

from surfkit.apps.doctor import command as doctor
from surfkit.apps.doctor.estimate import ResourceEstimate
from surfkit.apps.doctor.finding import Finding
from surfkit.apps.doctor.forecast import MachineLimits
from surfkit.cli import main
from surfkit.testing.synthetic import Flight, photograph, write_colmap


@pytest.fixture
def farm(tmp_path):
    folder = tmp_path / "farm"
    write_colmap(folder, photograph(Flight(kind="grid", views=16, width=64, height=48, points=1_200)))
    return folder


def estimated(**changes):
    values = dict(points=5_000, points_known=False, seconds=3_700.0, step_seconds=(0.1, 0.2), memory_bytes=10**9)
    values |= dict(
        cache_bytes=10**8, point_bytes=2e3, run_bytes=10**8, data_bytes=0, room=MachineLimits(10**10, 10**11, 10**11)
    )
    return ResourceEstimate(**(values | changes))


def test_for_people(farm, capsys):
    assert main(["doctor", str(farm), "--probe", "0"]) == 0
    out = capsys.readouterr().out
    assert "PINHOLE 64 x 48" in out and "train on 14 photographs" in out and out.endswith("ready to train\n")
    (farm / "images/view_003.png").unlink()
    (farm / "images/view_004.png").write_bytes(b"")
    assert main(["doctor", str(farm)]) == 2
    out = capsys.readouterr().out
    lines = [line for line in out.splitlines() if line.startswith("error: ")]
    assert len(lines) == 2 and "missing: 'view_003.png'" in lines[0] and "'view_004.png'" in lines[1]
    assert out.endswith("2 errors; the estimate comes when the errors are put right\n")


def test_for_programs(farm, capsys, monkeypatch):
    asked = []

    def forecast(data, recipe, examined, plan, told):
        asked.append((recipe, plan))
        return estimated(), [Finding("warning", "memory", "too much")]

    monkeypatch.setattr(doctor, "forecast", forecast)
    words = ["recipe:3dgs", "--pretrain.near", "0.01", "--json", "--points", "9000", "--steps", "300"]
    assert main(["doctor", str(farm), *words]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["sound"] is True and told["found"]["layout"] == "colmap" and told["estimate"]["seconds"] == 3_700
    assert [(finding["level"], finding["what"]) for finding in told["findings"]] == [("warning", "memory")]
    main(["doctor", str(farm), "--json", "pretrain.appearance:exposure", "--pretrain.near", "0.02"])
    capsys.readouterr()
    (recipe, plan), (usual, _) = asked
    assert usual.pretrain.appearance is not None and usual.pretrain.near == 0.02 and usual.pretrain.steps == 30_000
    assert (recipe.pretrain.near, recipe.pretrain.steps, plan.points, plan.steps) == (0.01, 300, 9_000, 50)
    assert main(["doctor", str(farm / "none"), "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert told["sound"] is False and "no such folder" in told["findings"][0]["text"] and told["estimate"] is None


def test_an_estimate_in_words(farm, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "forecast", lambda *_: (estimated(data_bytes=2 * 10**9), []))
    assert main(["doctor", str(farm)]) == 0
    out = capsys.readouterr().out
    for words in (
        "5,000 likely, 1,667 to 15,000 possible",
        "1 h 2 min (100, 200 ms",
        "1.0 GB, of which photographs",
    ):
        assert words in out
    assert "100 MB for the run folder" in out and "2.0 GB for undistorted photographs" in out


def test_words_that_do_not_fit(farm, capsys):
    for words, said in (
        (["--probe", "-1"], "--probe -1: give 0 (no estimate) to 10000 steps"),
        (["--points", "0"], "--points 0: give 1 to 2147483647"),
        (["recipe:none"], "no recipe named 'none'"),
        (["--scale", "0.5"], "--scale 0.5"),
        (["--scal", "4"], "no option --scal; perhaps you meant --scale"),
        (["--pretrain.stepz", "3"], "no option --pretrain.stepz; perhaps you meant --pretrain.steps"),
        (["pretrain.densify:nothing"], "'nothing'"),
    ):
        assert main(["doctor", str(farm), *words]) == 2
        assert said in capsys.readouterr().err
