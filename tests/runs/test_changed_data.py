"""A data set that changed after a run was trained: what uses both refuses before it writes."""

import json
import os
import re
import shutil

import pytest
from needs import needs

from surfkit.apps.view.viewer_scene import opened_subject
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.runs.pipeline import loaded, opened, run
from surfkit.testing.synthetic import Flight, photograph, write_colmap

WORDS = ["recipe:2dgs", "--steps", "2", "--pictures-every", "0", "--primitive.sh-degree", "0"]
PROCESSES = {
    "evaluate": [],
    "evaluate --gt": ["--gt", "RUN/mesh.ply"],
    "mesh": [],
    "texture": [],
    "maps": ["--products", "hillshade"],
    "render": ["--seconds", "0.1", "--out", "RUN/frames"],
    "compress": [],
    "lod": [],
    "export": [],
}
NEEDED = {"texture": "fast_simplification", "maps": "rasterio"}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source")
    write_colmap(folder / "data", photograph(Flight(views=9, width=32, height=24, points=60)))
    assert main(["train", *WORDS, "--data", str(folder / "data"), "--out", str(folder / "run")]) == 0
    return folder


@pytest.fixture
def trained(source, tmp_path):
    """A run of one's own, and a data set of one's own, as if it had been trained on that."""
    shutil.copytree(source, tmp_path, dirs_exist_ok=True)
    write_record(tmp_path / "run", data={"path": str(tmp_path / "data")})
    return tmp_path / "run", tmp_path / "data"


def write_record(out, data=None, **facts):
    """Change what run.json says."""
    record = json.loads((out / "run.json").read_text())
    record |= facts | {"data": record["data"] | (data or {})}
    (out / "run.json").write_text(json.dumps(record))


def rewritten(path, change):
    """Change the lines of a COLMAP text file that hold something, as lists of words."""
    lines = [line.split() for line in path.read_text().splitlines()]
    change(lines)
    path.write_text("".join(" ".join(words) + "\n" for words in lines))


def photographs(data):
    path = data / "images" / "view_003.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def one_camera(data):
    def change(lines):
        lines[0][5] = repr(float(lines[0][5]) + 0.1)  # held out: others move the frame

    rewritten(data / "sparse/0/images.txt", change)


def points(data):
    rewritten(data / "sparse/0/points3D.txt", lambda lines: lines.pop())


def masks(data):
    shutil.copytree(data / "images", data / "masks")


def enlarged(data, by=2.0, shift=0.0):
    """The same reconstruction in other units, or elsewhere: in the local frame of a run, nothing changes."""

    def cameras(lines):
        from scipy.spatial.transform import Rotation

        for words in lines[::2]:
            w, x, y, z = map(float, words[1:5])
            moved = Rotation.from_quat([x, y, z, w]).apply([shift, 0, 0])
            words[5:8] = [repr(float(value) * by - float(more)) for value, more in zip(words[5:8], moved, strict=True)]

    def xyz(lines):
        for words in lines:
            words[1:4] = [repr(float(value) * by + (shift if at == 0 else 0)) for at, value in enumerate(words[1:4])]

    rewritten(data / "sparse/0/images.txt", cameras)
    rewritten(data / "sparse/0/points3D.txt", xyz)


def moved(data):
    """What is rounded otherwise may show in a camera, too."""
    enlarged(data, by=1.0, shift=64.0)


CHANGES = [
    (photographs, "photograph view_003.png has changed"),
    (one_camera, "the camera of view_000.png has changed"),
    (points, "the sparse points have changed"),
    (masks, "the mask of view_001.png has changed, come or gone and 8 more"),
    (enlarged, r"the reconstruction has other coordinates: .*, and the extent of the scene \S+ and is"),
    (moved, "(the reconstruction has other coordinates: the middle of its cameras was .* and is|the camera of)"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=lambda value: getattr(value, "__name__", ""))
def test_what_changed_is_named(trained, change, message):
    out, data = trained
    change(data)
    told = rf"{out}: the data in {data} have changed since the run was trained: {message}.*;"
    with pytest.raises(BadInput, match=told), loaded(out, "cpu"):
        pass
    with pytest.raises(BadInput, match=f"began with: {message}"):  # as the command that trains
        run(opened(out).recipe, Data(data), out)


@pytest.mark.parametrize("words", PROCESSES)
def test_every_command_refuses_before_it_writes(trained, words, capsys):
    if words in NEEDED:
        needs(NEEDED[words])
    out, data = trained
    moved(data)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    more = [word.replace("RUN", str(out)) for word in PROCESSES[words]]
    assert main([words.split()[0], str(out), *more]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "have changed since the run was trained" in said
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_the_same_content_is_no_change(trained, capsys):
    """Touched, copied and linked to; a run of a version that kept no fingerprint; a photograph the run has skipped."""
    out, data = trained
    for path in (data / "images").iterdir():
        os.utime(path, (1, 1))
    data.rename(data.with_name("elsewhere"))
    assert main(["export", str(out)]) == 2
    assert f"{out}: its data set {data} is not there" in capsys.readouterr().err
    data.symlink_to(data.with_name("elsewhere"))
    assert main(["export", str(out)]) == 0
    record = json.loads((out / "run.json").read_text())
    photographs(data)
    (out / "run.json").write_text(json.dumps(record | {"skipped": ["view_003.png"]}))
    assert main(["export", str(out)]) == 0
    (out / "run.json").write_text(json.dumps(record))
    assert main(["export", str(out)]) == 2
    (out / "inputs.json").unlink()
    assert main(["export", str(out)]) == 0


def test_a_run_and_its_data_that_move_together_stay_a_run(trained, tmp_path, capsys):
    out, data = trained
    write_record(out, folder=str(out), data={"masks": str(data / "masks")})
    there = tmp_path / "elsewhere"
    there.mkdir()
    for each in (out, data):
        shutil.move(each, there / each.name)
    found = opened(there / "run").data
    assert (found.path, found.masks) == (there / "data", there / "data/masks")
    write_record(there / "run", data={"masks": None})
    assert main(["mesh", str(there / "run")]) == 0
    places = ["--data", str(there / "data"), "--out", str(there / "run")]
    assert main(["train", *WORDS, *places]) == 0, capsys.readouterr().err
    assert json.loads((there / "run/run.json").read_text())["data"]["path"] == str(there / "data")


def test_other_data_in_that_place_are_refused(trained, tmp_path, capsys):
    out, data = trained
    write_record(out, folder=str(out))
    (tmp_path / "elsewhere").mkdir()
    for each in (out, data):
        shutil.move(each, tmp_path / "elsewhere" / each.name)
    photographs(tmp_path / "elsewhere/data")
    assert main(["mesh", str(tmp_path / "elsewhere/run")]) == 2
    assert "have changed since the run was trained" in capsys.readouterr().err


def test_data_that_moved_alone_are_not_found(trained, tmp_path, capsys):
    out, data = trained
    write_record(out, folder=str(out))
    shutil.move(data, tmp_path / "moved")
    assert main(["mesh", str(out)]) == 2 and "is not there; put it back" in capsys.readouterr().err


def test_another_version_may_have_read_it_otherwise(trained):
    out, data = trained
    record = json.loads((out / "run.json").read_text())
    record["versions"]["surfkit"] = "0.0.1"
    (out / "run.json").write_text(json.dumps(record))
    moved(data)
    with pytest.raises(BadInput, match=r"\(or surfkit \S+ .*0\.0\.1"), loaded(out, "cpu"):
        pass


def test_the_viewer_notes_it(trained, monkeypatch):
    out, data = trained
    moved(data)
    said = []
    monkeypatch.setattr("surfkit.runs.resume.emit", lambda event: said.append(event.text))
    with opened_subject(out, "cpu") as subject:
        assert len(subject.views) == 9
    assert len(said) == 1 and re.search("have changed since the run .* need not fit", said[0])
