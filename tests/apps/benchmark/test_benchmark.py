"""`surfkit benchmark` on made-up folders: what is missing, results, going on, and what has changed."""

import csv
import io
import json
import os
import shutil
from dataclasses import replace

import pytest
import torch

from surfkit.apps.benchmark import protocols
from surfkit.apps.benchmark.benchmark_results import head_and_cells, report_of
from surfkit.apps.benchmark.data_record import data_hash, pictures_in
from surfkit.apps.benchmark.protocols import PROTOCOLS
from surfkit.cli import main
from surfkit.io.datasets import fingerprint
from surfkit.io.datasets.read import read
from surfkit.study import rows
from surfkit.study.metric_columns import TABLE_COLUMNS
from surfkit.study.row_comparison import figures
from tests.apps.benchmark.made_up import city, city_protocol, copy


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    torch.set_num_threads(2)
    folder = tmp_path_factory.mktemp("benchmark") / "data"
    city(folder)
    return folder


@pytest.fixture
def tiny(monkeypatch):
    made = city_protocol()
    monkeypatch.setitem(protocols.PROTOCOLS, "tiny", made)
    return made


@pytest.fixture(scope="module")
def done(root, quick_comparison):
    """Results of both scenes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(protocols.PROTOCOLS, "tiny", city_protocol())
        out = root.parent / "done"
        assert main(["benchmark", "tiny", "--root", str(root), "--out", str(out)]) == 0
    return out


@pytest.fixture
def no_training(monkeypatch):
    """Nothing is trained or measured."""
    began = []
    monkeypatch.setattr(rows, "train", lambda work: began.append(work.trial.folder.name) or 1 / 0)
    return began


def tiny_run(root, out, *words):
    return main(["benchmark", "tiny", "--root", str(root), "--out", str(out), *words])


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["dtv"], "no benchmark named 'dtv'; did you mean 'dtu'?"),
        (["dtu"], "--root missing: "),
        (["--check"], "name a benchmark: gauu-scene, matrixcity, "),
        (["dtu", "--root", "d", "--seeds", "0"], "--seeds 0: give 1 or more"),
        (["dtu", "--root", "d", "--scenes", "scan25"], "--scenes: no scene named 'scan25'; did you mean "),
        (["dtu", "--root", "d", "--recipes", "2dsg"], "--recipes: no recipe named '2dsg'; did you mean '2dgs'?"),
        (["dtu", "--root", "d", "--recipes", "2dgs", "2dgs"], "--recipes: 2dgs is there twice; name each once"),
        (["dtu", "--check", "--describe"], "--check, --describe and --show each do one thing; give one"),
        (["dtu", "--describe", "--scenes", "scan24"], "--scenes: --describe does not read it; leave it out"),
        (["dtu", "--show", "--seeds", "2"], "--seeds: --show does not read it; leave it out"),
        (["dtu", "--show"], "--out runs/dtu-1: no results of a benchmark in it"),
    ],
)
def test_what_users_get_wrong_is_one_line(monkeypatch, tmp_path, capsys, words, line):
    monkeypatch.chdir(tmp_path)
    assert main(["benchmark", *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"surfkit: {line}") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_list_and_the_protocol_in_words(capsys):
    assert main(["benchmark"]) == 0
    told = capsys.readouterr().out
    assert all(each.tag in told and each.about in told for each in PROTOCOLS.values())
    assert main(["benchmark", "tanks-and-temples", "--describe"]) == 0
    told = capsys.readouterr().out
    assert "tau 0.003 m" in told and "scene barn needs Barn/Barn_trans.txt" in told and "longest 960" in told


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=list(PROTOCOLS))
def test_all_that_is_missing_is_told_at_once(monkeypatch, tmp_path, capsys, protocol):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    assert main(["benchmark", protocol.name, "--root", "data"]) == 2
    *lines, last = capsys.readouterr().err.splitlines()
    for scene in protocol.scenes:
        for needed in (*scene.needed, *scene.truth.needed()):
            (line,) = (line for line in lines if line.startswith(f"{scene.name}: data/{needed.path}: missing"))
            assert needed.what in line and protocol.sources[needed.source] in line
    assert (
        last == f"surfkit: data: not as {protocol.tag} has it: {len(lines)} faults, listed above; nothing was trained"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_data_one_level_too_deep_are_found_and_named(monkeypatch, tmp_path, capsys):
    """As archives unpack: data/training/Barn instead of data/Barn."""
    monkeypatch.chdir(tmp_path)
    os.makedirs("data/training/Barn/images")
    open("file", "w").close()
    assert main(["benchmark", "tanks-and-temples", "--root", "data", "--scenes", "barn", "--check"]) == 2
    said = capsys.readouterr().err
    assert "data/Barn/images: missing, but data/training/Barn/images is there: move it" in said
    assert "data/Barn/Barn.ply: missing; it is" in said
    os.makedirs("many/another/images")
    os.makedirs("many/another/sparse/0")
    assert main(["benchmark", "shibuya", "--root", "many", "--check"]) == 2
    assert "is there" not in capsys.readouterr().err, "what lies there may be another scene"
    os.makedirs("many/right/gt/mesh.ply")
    shutil.copytree("many/another", "many/right", dirs_exist_ok=True)
    assert main(["benchmark", "shibuya", "--root", "many", "--check"]) == 2
    said = capsys.readouterr().err
    assert said.count("move it, or name many/right with --root") == 3 and "another" not in said
    assert main(["benchmark", "tanks-and-temples", "--root", "file", "--check"]) == 2
    assert "file: a file, not a folder; name with --root" in capsys.readouterr().err


def test_what_is_not_as_it_should_be(root, tiny, tmp_path, capsys, monkeypatch):
    folder = copy(root, tmp_path / "data")
    (folder / "A/images/view_001.png").unlink()
    (folder / "A/images/view_002.png").write_bytes(b"no picture")
    cut = folder / "A/images/view_003.png"
    cut.write_bytes(cut.read_bytes()[:-20])
    (folder / "ground_truth/A.ply").write_text("ply\nno cloud")
    lines = (folder / "ground_truth/B.ply").read_text().splitlines()
    lines[2] = "element vertex 20"
    (folder / "ground_truth/B.ply").write_text("\n".join(lines[:27]) + "\n")
    monkeypatch.setitem(
        protocols.PROTOCOLS,
        "tiny",
        replace(tiny, scenes=(tiny.scenes[0], replace(tiny.scenes[1], training=(7, 7)))),
    )
    assert tiny_run(folder, tmp_path / "out", "--check") == 2
    said = capsys.readouterr().err
    assert "8 pictures, where there must be 9; it is the photographs, from the page of photographs, https://" in said
    assert "cannot be read, or end too early: 2 of 8, 'view_002.png', 'view_003.png'" in said
    assert f"{folder}/ground_truth/A.ply: cannot be used: " in said
    assert "20 points, where there must be 100 or more; it is the laser scan, from the page of scans" in said
    assert "6 training photographs, where there must be 7" in said
    assert not (tmp_path / "out").exists()
    for picture in (folder / "A/images").iterdir():
        if picture.name != "view_003.png":
            picture.unlink()
    assert tiny_run(folder, tmp_path / "out", "--check") == 2
    assert "images: 1 picture, where there must be 9" in capsys.readouterr().err


def test_small_photographs_are_noticed(root, tiny, tmp_path, capsys, monkeypatch):
    needed = replace(tiny.scenes[0].needed[0], longest=49)
    scene = replace(tiny.scenes[0], needed=(needed, *tiny.scenes[0].needed[1:]))
    monkeypatch.setitem(protocols.PROTOCOLS, "tiny", replace(tiny, scenes=(scene,)))
    assert tiny_run(root, tmp_path / "out", "--check") == 2
    assert "smaller than 49 px: 9 of 9, 'view_000.png', " in capsys.readouterr().err


def test_results_stand_beside_published_figures(done, tiny, root):
    report = json.loads((done / "benchmark.json").read_text())
    assert report["benchmark"] == "tiny-1" and report["protocol"]["digest"] == tiny.digest
    a, b, mean = report["rows"]
    assert [row["scene"] for row in report["rows"]] == ["a", "b", "mean"]
    assert a["published"] == {"f1": 0.5, "psnr": 20.0} and b["published"] == {} and mean["published"] == {"f1": 0.25}
    assert mean["mean"]["f1"] == pytest.approx((a["mean"]["f1"] + b["mean"]["f1"]) / 2)
    made = a["runs"][0]["made"]
    assert made["data"] == report["data"]["a"] != report["data"]["b"]
    assert made["torch"] == torch.__version__ and made["device"].startswith("cpu")
    page = (done / "benchmark.md").read_text()
    assert f"| a | 2dgs | 1 | {a['mean']['psnr']:.2f} (20.00) |" in page and f"{a['mean']['f1']:.3f} (0.500)" in page
    assert tiny.digest in page and report["data"]["a"] in page and "Published figures: A paper, 2024." in page
    lines = list(csv.DictReader(io.StringIO((done / "benchmark.csv").read_text())))
    assert [line["scene"] for line in lines] == ["a", "b", "mean"]
    assert float(lines[0]["f1"]) == a["mean"]["f1"] and lines[0]["published_f1"] == "0.5"
    assert lines[1]["data"] == report["data"]["b"] and lines[0]["published_recall"] == ""


def test_the_same_command_trains_nothing_again(done, tiny, root, no_training, capsys):
    before = json.loads((done / "benchmark.json").read_text())
    assert tiny_run(root, done) == 0
    after = json.loads((done / "benchmark.json").read_text())
    assert after["rows"] == before["rows"] and not no_training
    assert main(["benchmark", "tiny", "--show", "--out", str(done)]) == 0
    assert before["data"]["b"] in capsys.readouterr().out


def test_another_command_keeps_what_is_there(done, tiny, root, no_training, tmp_path, capsys):
    out = copy(done, tmp_path / "out")
    assert tiny_run(root, out, "--scenes", "b", "--recipes", "3dgs") == 1, "it is not trained, so it fails"
    assert len(no_training) == 1
    report = json.loads((out / "benchmark.json").read_text())
    assert [(row["scene"], row["recipe"]) for row in report["rows"]] == [
        ("a", "2dgs"),
        ("b", "2dgs"),
        ("b", "3dgs"),
        ("mean", "2dgs"),
    ]
    assert "b, 3dgs: seed 0: ZeroDivisionError" in capsys.readouterr().err


def test_rows_of_another_recipe_or_version_are_not_kept(done, tiny):
    before = json.loads((done / "benchmark.json").read_text())
    still = report_of(tiny, 1, {}, {}, before)["rows"]
    assert [row["scene"] for row in still] == ["a", "b", "mean"]
    for change in ({"recipe_digest": "other"}, {"runs": [{**before["rows"][0]["runs"][0], "made": None}]}):
        changed = before | {"rows": [before["rows"][0] | change, before["rows"][1]]}
        assert [row["scene"] for row in report_of(tiny, 1, {}, {}, changed)["rows"]][0] == "b"


@pytest.mark.parametrize("what", ["A/images/view_003.png", "ground_truth/A.ply", "A/sparse/0/points3D.txt"])
def test_changed_data_are_refused(done, tiny, root, no_training, tmp_path, capsys, what):
    folder, out = copy(root, tmp_path / "data"), copy(done, tmp_path / "out")
    path = folder / what
    if path.suffix == ".png":
        path.write_bytes((folder / "A/images/view_004.png").read_bytes())
    else:
        *lines, last = path.read_text().splitlines()
        words = last.split()
        path.write_text("\n".join([*lines, " ".join(words[:1] + ["7"] + words[2:])]) + "\n")
    assert tiny_run(folder, out) == 2
    said = capsys.readouterr().err
    assert f"--out {out} has results of tiny-1, as a/runs/" in said and "of other data" in said
    assert not no_training


def test_another_declaration_of_the_same_version_is_refused(done, tiny, root, no_training, monkeypatch, capsys):
    monkeypatch.setitem(protocols.PROTOCOLS, "tiny", replace(tiny, steps=7))
    assert tiny_run(root, done) == 2
    assert "by another declaration of that version" in capsys.readouterr().err
    assert not no_training


@pytest.mark.parametrize("show", [True, False])
def test_results_of_another_benchmark_stay(done, tiny, root, no_training, tmp_path, monkeypatch, capsys, show):
    out = copy(done, tmp_path / "out")
    before = (out / "benchmark.json").read_bytes()
    monkeypatch.setitem(protocols.PROTOCOLS, "tiny", replace(tiny, version=2))
    assert (main(["benchmark", "tiny", "--show", "--out", str(out)]) if show else tiny_run(root, out)) == 2
    assert "has results of tiny-1, and this is tiny-2; name another folder" in capsys.readouterr().err
    assert (out / "benchmark.json").read_bytes() == before and not no_training


def test_a_file_that_holds_no_results_is_one_line(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(protocols.PROTOCOLS, "tiny", tiny)
    (tmp_path / "benchmark.json").write_text('{"a": 1}')
    assert main(["benchmark", "tiny", "--show", "--out", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_pictures_in_folders_that_are_links_count(tmp_path):
    """Each once, also where links lead round in a circle; not what macOS writes beside files."""
    (tmp_path / "real/inner").mkdir(parents=True)
    (tmp_path / "images").mkdir()
    for name in ("real/a.jpg", "real/._a.jpg", "real/inner/b.png", "real/c.txt", "images/d.jpg"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "images/linked").symlink_to(tmp_path / "real")
    (tmp_path / "real/inner/up").symlink_to(tmp_path / "images")
    names = [path.relative_to(tmp_path / "images").as_posix() for path in pictures_in(tmp_path / "images")]
    assert names == ["d.jpg", "linked/a.jpg", "linked/inner/b.png"]


def test_the_hash_is_of_what_is_read(root, tiny, tmp_path, monkeypatch):
    def hashed(folder, out):
        (scene, _) = tiny.scenes
        files = [folder / each.path for each in scene.truth.needed()]
        return data_hash(read(scene.data(folder)), files, folder, tmp_path / out)

    first, other = hashed(root, "one"), copy(root, tmp_path / "elsewhere")
    os.utime(other / "ground_truth/A.ply", (1, 1))
    assert hashed(other, "two") == first, "neither place nor times of files count"
    monkeypatch.setattr(fingerprint, "_content", lambda *_: 1 / 0)
    assert hashed(root, "one") == first, "what was not touched is not read again"
    with pytest.raises(ZeroDivisionError):
        hashed(root, "three")


def test_figures_of_runs_without_test_photographs():
    images = {"psnr": None, "ssim": None, "per_image": {}}
    geometry = {"chamfer_dtu": {"accuracy": 1.0, "completeness": 2.0, "overall": 1.5, "far": 20.0}}
    metrics = {"images": images, "geometry": geometry, "points": 3, "seconds": 1.0, "cpu_seconds": 2.0}
    found = figures(metrics)
    assert "psnr" not in found and (found["accuracy"], found["completeness"], found["chamfer"]) == (1.0, 2.0, 1.5)


def test_a_column_of_zeros_is_shown(tiny):
    """An F1 of 0 is a figure; one that nobody has measured is none."""
    row = {"scene": "a", "recipe": "2dgs", "runs": [{}], "mean": {"psnr": 20.0, "f1": 0.0}, "sd": {}, "published": {}}
    head, (cells,) = head_and_cells({"columns": ["psnr", "f1", "ssim"], "rows": [row]})
    assert head[3:] == [TABLE_COLUMNS[name].head for name in ("psnr", "f1")] and float(cells[-1]) == 0
