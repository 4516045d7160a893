"""Photographs that share no sparse points with the others are told; what is told agrees with sets that are joined."""

import json

import numpy as np
import pytest

from surfkit.apps.doctor.examine import examine
from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.runs.run_notes import collect_notes
from surfkit.scene import connected_photos as groups
from surfkit.scene.connected_photos import connect_groups, groups_warning, untied_warning
from surfkit.testing.synthetic import Flight, photograph, write_colmap

FLIGHT = Flight(kind="grid", views=16, width=24, height=18, points=400)


def joined(tracks):
    """Groups of what occurs in tracks, by joining sets until none overlap."""
    found = []
    for track in filter(None, map(set, tracks)):
        near = [group for group in found if group & track]
        found = [group for group in found if not group & track] + [track.union(*near)]
    return found


@pytest.mark.parametrize("batch", [1, 7, 20_000])
@pytest.mark.parametrize("seed", range(6))
def test_groups_are_those_of_sets_that_are_joined(monkeypatch, batch, seed):
    monkeypatch.setattr(groups, "BATCH_TRACKS", batch)
    draw = np.random.default_rng(seed)
    tracks = [draw.integers(0, 60, draw.integers(0, 4)).tolist() for _ in range(30)]
    found = connect_groups(60, tracks)
    assert [len(group) for group in found] == sorted(map(len, found), reverse=True)
    assert {frozenset(group.tolist()) for group in found} == set(map(frozenset, joined(tracks)))


def test_no_more_is_read_than_connects_all(monkeypatch):
    monkeypatch.setattr(groups, "BATCH_TRACKS", 10)
    chain = iter([[at, at + 1] for at in range(24)] + [[0, 0]] * 100)
    assert [group.tolist() for group in connect_groups(25, chain)] == [list(range(25))]
    assert len(list(chain)) == 94
    assert connect_groups(0, []) == connect_groups(3, []) == connect_groups(3, [[], []]) == []


def test_the_line_names_sizes_and_one_photograph_of_each_smaller_group():
    assert groups_warning([]) is groups_warning([["a", "b"]]) is None
    assert "2 groups without common sparse points, of 3 and 1 ('d' for one): " in groups_warning(
        [["a", "b", "c"], ["d"]]
    )
    many = groups_warning([["a"] * 9, *([name] * (8 - at) for at, name in enumerate("bcdefg"))])
    assert "7 groups" in many and many.count("for one") == 4
    assert "of 9, 8 ('b' for one), 7 ('c' for one), 6 ('d' for one), 5 ('e' for one) and 2 more of up to 4: " in many
    assert "\n" not in many


def test_photographs_without_a_point_are_named():
    assert untied_warning([]) is None
    assert untied_warning(["b"]).startswith("1 photograph to train on shows no sparse point, 'b': ")
    text = untied_warning(["b", "d", "f"])
    assert text.startswith("3 photographs to train on show no sparse point, 'b', 'd', 'f': ") and "\n" not in text


def untie(model, number):
    """Take the observations of one image out of a model in text."""
    rows = [row.split(" ") for row in (model / "points3D.txt").read_text().splitlines()]
    for words in rows:
        pairs = [pair for pair in zip(words[8::2], words[9::2], strict=True) if int(pair[0]) != number]
        words[8:] = [word for pair in pairs for word in pair]
    (model / "points3D.txt").write_text("\n".join(" ".join(words) for words in rows) + "\n")
    lines = (model / "images.txt").read_text().splitlines()
    for at in range(0, len(lines), 2):
        if int(lines[at].split(" ")[0]) == number:
            words = lines[at + 1].split(" ")
            words[2::3] = ["-1"] * len(words[2::3])
            lines[at + 1] = " ".join(words)
    (model / "images.txt").write_text("\n".join(lines) + "\n")


def split(model, of):
    """Take the observations out of a model in text that connect groups: each point stays in the photographs of one.

    Args:
        model: Its folder.
        of: From the number of an image to its group.
    """
    points = [row.split(" ") for row in (model / "points3D.txt").read_text().splitlines()]
    kept, rows = {}, []
    for words in points:
        numbers = words[8::2]
        group = of(int(numbers[int(words[0]) % len(numbers)])) if numbers else 0
        kept[words[0]] = group
        track = [(a, b) for a, b in zip(numbers, words[9::2], strict=True) if of(int(a)) == group]
        rows.append(" ".join([*words[:8], *(word for pair in track for word in pair)]))
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    lines = (model / "images.txt").read_text().splitlines()
    for at in range(0, len(lines), 2):
        group, words = of(int(lines[at].split(" ")[0])), lines[at + 1].split(" ")
        words[2::3] = [word if kept[word] == group else "-1" for word in words[2::3]]
        lines[at + 1] = " ".join(words)
    (model / "images.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def made():
    return photograph(FLIGHT)


def told(folder, what="unconnected"):
    found = examine(Data(folder), recipes()["2dgs"], quick=True).diagnosis.findings
    return [finding for finding in found if finding.what == what]


@pytest.mark.parametrize("binary", [False, True])
def test_connected_photographs_and_those_without_observations_are_not_told(made, tmp_path, binary):
    write_colmap(tmp_path / "with", made, tracks=True, binary=binary)
    write_colmap(tmp_path / "without", made, binary=binary)
    assert told(tmp_path / "with") == told(tmp_path / "without") == []
    assert told(tmp_path / "with", "untied") == told(tmp_path / "without", "untied") == []


def test_doctor_and_readers_tell_photographs_without_a_point(made, tmp_path):
    write_colmap(tmp_path, made, tracks=True)
    untie(tmp_path / "sparse/0", 9)  # held out
    assert not told(tmp_path, "untied")
    untie(tmp_path / "sparse/0", 12)
    line = "1 photograph to train on shows no sparse point, 'view_011.png': "
    (finding,) = told(tmp_path, "untied")
    assert finding.level == "warning" and finding.text.startswith(line) and finding.names == ("view_011.png",)
    assert not told(tmp_path)
    with collect_notes() as kept:
        read(Data(tmp_path))
    assert len([text for text in kept.texts if text.startswith(line)]) == 1


def test_doctor_and_train_tell_groups_and_training_goes_on(made, tmp_path, capsys):
    data, out = tmp_path / "data", tmp_path / "run"
    write_colmap(data, made, tracks=True)
    split(data / "sparse/0", lambda number: (number > 10) + (number == 16))
    line = (
        "the photographs fall into 3 groups without common sparse points, of 10, 5 ('view_010.png' for one) and "
        "1 ('view_015.png' for one): nothing in them tells how the groups lie to one another; "
    )
    (finding,) = told(data)
    assert finding.level == "warning" and finding.text.startswith(line) and finding.text.count("groups without") == 1
    assert finding.names == tuple(f"view_{at:03}.png" for at in range(10, 16))
    words = ["train", "recipe:2dgs", "--steps", "2", "--device", "cpu", "--primitive.sh-degree", "0", "mesh:none"]
    assert main([*words, "--data", str(data), "--out", str(out)]) == 0
    assert capsys.readouterr().err.count(f"note: {line}") == 1
    assert [note for note in json.loads((out / "run.json").read_text())["notes"] if note.startswith(line)]
