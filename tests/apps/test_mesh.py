"""`surfkit mesh`, and the mesh at the end of `surfkit train`."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from needs import needs
from PIL import Image
from polygon_files import write_polygons

from surfkit.cli import main
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.mesh.tsdf import TSDF
from surfkit.testing.synthetic import Flight, photograph, write_colmap

trimesh = needs("trimesh")
TRAIN = ["recipe:2dgs", "--steps", "60", "--pictures-every", "0", "--primitive.sh-degree", "0"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    write_colmap(folder / "data", photograph(Flight(width=64, height=48, points=400)))
    where = ["--data", str(folder / "data"), "--out", str(folder / "run")]
    assert main(["train", *TRAIN, *where]) == 0
    return folder / "run", where


def record(out):
    return json.loads((out / "mesh.json").read_text())


def test_training_ends_with_a_mesh(finished, capsys):
    out, _ = finished
    facts = record(out)
    mesh = trimesh.load(out / "mesh.ply", process=False)
    assert len(mesh.faces) == facts["cleaning"]["triangles"] > 100 and facts["steps"] == 60
    assert facts["mesher"]["use"] == "tsdf" and facts["facts"]["voxel"] > 0
    # The ground is at z = 0 in the frame of the input, and the box and the ball are below 5 m.
    assert abs(np.median(mesh.vertices[:, 2])) < 2 and mesh.vertices[:, 2].max() < 30
    pictures = sorted(path.name for path in (out / "mesh_pictures").iterdir())
    assert pictures == ["above.png", "view-1.png", "view-2.png", "view-3.png", "view-4.png"]
    with Image.open(out / "mesh_pictures" / "view-1.png") as picture:
        assert picture.size == (2 * 64, 48) and np.asarray(picture)[:, 64:].min() < 200
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    progress = [event for event in events if event["event"] == "Progress"]
    assert len(progress) == 1 and progress[0]["done"] == progress[0]["total"] == 10, "the way there is not written down"


def test_the_same_command_again_makes_nothing_and_another_mesher_only_the_mesh(finished, capsys):
    out, where = finished
    before, checkpoint = record(out), (out / "pretrain" / "checkpoint.safetensors").stat().st_mtime_ns
    assert main(["train", *TRAIN, *where]) == 0
    assert record(out) == before and "is finished" in capsys.readouterr().err
    assert main(["train", *TRAIN, "mesh:tsdf", "--mesh.depth", "expected", *where]) == 0
    assert record(out)["mesher"]["depth"] == "expected"
    assert (out / "pretrain" / "checkpoint.safetensors").stat().st_mtime_ns == checkpoint
    assert main(["train", *TRAIN, *where]) == 0
    assert record(out)["mesher"] == before["mesher"]


def test_another_mesh_of_the_same_run(finished, tmp_path, capsys, quick_comparison):
    out, _ = finished
    words = ["mesh:tsdf", "--mesh.voxel", "0.5", "--mesh.least-views", "0.5", "--metres-per-unit", "1"]
    words += ["--formats", "ply", "obj", "glb", "--lods", "0.5", "--least-triangles", "20", "--crop-box"]
    assert main(["mesh", str(out), *words, "-50", "-50", "-2", "50", "50", "3"]) == 0
    facts = record(out)
    assert facts["facts"]["voxel_m"] == pytest.approx(0.5) and facts["metres_per_unit"] == 1
    assert sorted(facts["files"]) == sorted(
        ["mesh.ply", "mesh.obj", "mesh.glb", "mesh.glb.json"]
        + [f"mesh-lod1.{end}" for end in ("ply", "obj", "glb", "glb.json")]
    )
    assert all((out / name).stat().st_size > 100 for name in facts["files"])
    whole, less = (trimesh.load(out / f"{name}.ply", process=False) for name in ("mesh", "mesh-lod1"))
    assert len(less.faces) <= 0.55 * len(whole.faces)
    assert -2.5 < whole.vertices[:, 2].min() and whole.vertices[:, 2].max() < 3.5
    shown = capsys.readouterr().out
    assert f"{len(whole.faces):,}" in shown and "mesh-lod1.obj" in shown
    assert (
        main(["evaluate", str(out), "--gt", str(out / "mesh.ply"), "--tau", "0.5", "--draws", "1", "--crop", "none"])
        == 0
    )
    assert "geometry" in json.loads((out / "metrics.json").read_text())
    capsys.readouterr()
    assert main(["mesh", str(out), "--formats", "ply"]) == 0
    said = capsys.readouterr().err
    assert "mesh-lod1.ply, mesh.glb, mesh.glb.json, mesh.obj of" in said
    assert "precision, recall and F1 were of the mesh before" in said
    assert "geometry" not in json.loads((out / "metrics.json").read_text())
    assert not list(out.glob("mesh-lod*")) and not (out / "mesh.obj").exists(), "what was there before is gone"


def test_fewer_triangles(finished, capsys):
    out, _ = finished
    words = ["mesh:tsdf", "--clusters", "1", "--cluster-gap", "0"]
    assert main(["mesh", str(out), *words, "--triangles", "2000", "--lods", "0.5"]) == 0
    facts = record(out)
    whole, less = (trimesh.load(out / f"{name}.ply", process=False) for name in ("mesh", "mesh-lod1"))
    assert len(whole.faces) == facts["triangles"] <= 2000 and len(less.faces) <= 1000
    assert facts["simplification"]["triangles_before"] == facts["cleaning"]["triangles"] > 2 * 2000
    shown = capsys.readouterr().out
    assert f"{len(whole.faces):,}" in shown and f"{facts['cleaning']['triangles']:,} triangles" in shown
    assert main(["mesh", str(out), *words, "--error", "0.02", "--triangles", "8", "--metres-per-unit", "1"]) == 0
    assert 2000 < record(out)["triangles"] < facts["cleaning"]["triangles"]
    assert "farther than --error" in capsys.readouterr().err
    assert main(["mesh", str(out), "mesh:tsdf", "--triangles", "8"]) == 0
    assert "; --cluster-gap 0" in capsys.readouterr().err


def test_a_closed_mesh(finished, capsys):
    """By trimesh, as it reads the files: in all formats and levels."""
    out, _ = finished
    words = ["--watertight", "--lods", "0.3", "--formats", "ply", "glb", "obj", "--error", "0.02"]
    assert main(["mesh", str(out), "mesh:tsdf", *words, "--metres-per-unit", "1"]) == 0
    for name in ("mesh", "mesh-lod1"):
        for kind in ("ply", "glb", "obj"):
            found = trimesh.load(out / f"{name}.{kind}", force="mesh")
            assert found.is_watertight and found.is_winding_consistent and found.volume > 0, (name, kind)
    closing = record(out)["closing"]
    low = trimesh.load(out / "mesh.ply").vertices[:, 2].min()
    assert closing["skirts"] >= 1 and closing["base"] == pytest.approx(low, abs=0.5)
    whole = trimesh.load(out / "mesh.ply", process=False)
    assert closing["volume"] == pytest.approx(whole.volume, rel=1e-6) and closing["bodies"] == whole.body_count
    assert "parts on a base, " in (shown := capsys.readouterr().out)
    assert re.search(rf"bodies +{whole.body_count}\b", shown)


def test_only_what_lies_in_an_area(finished, tmp_path, capsys):
    """The data set has no coordinate reference system; z is up, as the cameras tell."""
    out, _ = finished
    shapely = needs("shapely")
    shape = shapely.Polygon([(-6, -5), (7, -3), (1, 8)], [[(-1, -1), (1, -1), (0, 1)]])
    site = write_polygons(tmp_path / "site.shp", shape, crs=None)
    words = ["mesh:tsdf", "--least-triangles", "1", "--cluster-gap", "0", "--area", str(site)]
    assert main(["mesh", str(out), *words]) == 0
    mesh = trimesh.load(out / "mesh.ply", process=False)
    middles = mesh.triangles_center[:, :2]
    assert len(middles) > 100 and shapely.contains_xy(shape.buffer(1e-4), *middles.T).all()
    facts = record(out)
    assert facts["area"] == {"file": str(site), "polygons": 1, "area": pytest.approx(shape.area)}
    assert facts["cleaning"]["cropped"] > 0 and str(site) in capsys.readouterr().out
    high = -1.0 < mesh.triangles_center[:, 2]
    assert main(["mesh", str(out), *words, "--crop-box", "-50", "-50", "-1", "50", "50", "50"]) == 0
    assert 0 < len(trimesh.load(out / "mesh.ply", process=False).faces) <= high.sum()
    before = (out / "mesh.ply").read_bytes()
    far = write_polygons(tmp_path / "far.shp", shapely.box(1e6, 1e6, 2e6, 2e6), crs=None)
    assert main(["mesh", str(out), "mesh:tsdf", "--area", str(far)]) == 2
    said = capsys.readouterr().err
    assert f"--area {far}: polygon 1 ('a'): it lies within" in said and (out / "mesh.ply").read_bytes() == before


def test_what_is_known_of_each_vertex_is_written_and_drawn(finished, monkeypatch, capsys):
    """Of a mesher that counts views: colours of the picture, its words in the record and in the report."""
    out, _ = finished
    plain = TSDF.mesh

    def counted(self, subject):
        mesh = plain(self, subject)
        views = np.where(mesh.vertices[:, 0] > np.median(mesh.vertices[:, 0]), 12, 1).astype(np.float32)
        return replace(mesh, values={"views": views, "error": np.full(len(views), 0.5, np.float32)})

    monkeypatch.setattr(TSDF, "mesh", counted)
    assert main(["mesh", str(out), "mesh:tsdf", "--triangles", "3000"]) == 0
    facts = record(out)
    rows = read_surface(out / "mesh.ply").rows
    assert {1, 12} <= set(np.round(rows["views"])) and np.isfinite(rows["error"]).all()
    words = "views: red 1 or none, blue 10 or more photographs that confirm the surface"
    assert facts["pictures"]["above-views.png"] == words
    assert facts["pictures"]["above-error.png"].startswith("error: blue")
    with Image.open(out / "mesh_pictures" / "above-views.png") as picture:
        pixels = np.asarray(picture).reshape(-1, 3).astype(int)
    assert (pixels[:, 0] > pixels[:, 2] + 60).sum() > 100 < (pixels[:, 2] > pixels[:, 0] + 60).sum()
    assert main(["report", str(out)]) == 0 and words in (out / "report.html").read_text()
    wrong = {"sight": np.zeros(3)}
    monkeypatch.setattr(TSDF, "mesh", lambda self, subject: replace(plain(self, subject), values=wrong))
    capsys.readouterr()
    assert main(["mesh", str(out), "mesh:tsdf"]) == 2
    assert "'sight'; vertices may have views, error" in capsys.readouterr().err
    assert record(out) == facts


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["mesh:tsdf", "--mesh.voxel", "0"], "mesh.voxel is 0; it must be more than 0 metres, or auto"),
        (["mesh:tsdf", "--mesh.voxel", "1"], "--metres-per-unit (1 if its coordinates are metres)"),
        (["--metres-per-unit", "-1"], "--metres-per-unit -1"),
        (["--lods", "2"], "--lods 2: a share of the triangles lies between 0 and 1"),
        (["--triangles", "3"], "--triangles 3: give 4 or more"),
        (["--error", "0"], "--error 0: it must be more than 0"),
        (["--least-triangles", "0"], "--least-triangles 0: give 1 or more"),
        (["--memory", "much"], "--memory much: give a size"),
        (["--memory", "1MB"], "too little to mesh in"),
        (["--crop-box", "0", "0", "0", "1", "1", "1", "--crop", "x.json"], "give one of the two"),
        (["--crop", "none.json"], "none.json: no such file"),
        (["--crop-box", "900", "900", "900", "901", "901", "901"], "outside the crop"),
        (["mesh:tsdf", "--mesh.least-views", "999"], "no surface"),
        (["mesh:tsfd"], "tsdf"),
    ],
)
def test_mistakes_are_one_line_and_change_nothing(finished, capsys, words, message):
    out, _ = finished
    before = record(out)
    assert main(["mesh", str(out), *words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("surfkit:")]
    assert len(lines) == 1 and message in lines[0]
    assert record(out) == before and not list(out.glob(".*"))


def test_a_refused_recipe_leaves_the_mesh(finished):
    out, where = finished
    before = record(out)
    assert main(["train", *TRAIN, "mesh:tsdf", "--mesh.depth", "expected", "--seed", "7", *where]) == 2
    assert record(out) == before


def test_a_folder_without_a_run(tmp_path, capsys):
    assert main(["mesh", str(tmp_path)]) == 2
    assert "no run folder" in capsys.readouterr().err


def test_without_a_mesher_there_is_no_mesh(finished, tmp_path, capsys):
    _, where = finished
    assert (
        main(["train", "recipe:2dgs", "--steps", "1", "mesh:none", "--data", where[1], "--out", str(tmp_path / "a")])
        == 0
    )
    assert not (tmp_path / "a" / "mesh.json").exists() and "fusing" not in capsys.readouterr().err
    assert main(["train", "recipe:3dgs", "--steps", "1", "--data", where[1], "--out", str(tmp_path / "b")]) == 0
    assert not (tmp_path / "b" / "mesh.json").exists()


def test_a_mesh_that_cannot_be_made_does_not_cost_the_measurements(finished, tmp_path, capsys):
    _, where = finished
    words = ["recipe:2dgs", "--steps", "1", "mesh:tsdf", "--mesh.least-views", "999"]
    assert main(["train", *words, "--data", where[1], "--out", str(tmp_path / "run")]) == 0
    assert (tmp_path / "run" / "metrics.json").exists() and not (tmp_path / "run" / "mesh.ply").exists()
    notes = json.loads((tmp_path / "run" / "run.json").read_text())["notes"]
    assert any("there is no mesh: no surface" in note for note in notes)
