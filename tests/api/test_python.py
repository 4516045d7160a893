"""surfkit in Python: the page and the notebook run as they stand, on a made-up scene, and agree with the commands."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from models import data_set
from pages import ROOT, code

import surfkit
from surfkit.api.results import RunMesh
from surfkit.cli import main
from surfkit.io.splats.ply import write_points

TINY = {"SCENE": "scene", "scale=4": "scale=1", "steps=100": "steps=12", "triangles=50_000": "triangles=500"}
"""What is smaller here than on the page."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a data set, in which a run has been trained and used as the page does."""
    found = tmp_path_factory.mktemp("python")
    data_set(found / "scene")
    return found


def executed(text, folder, names):
    for long, short in TINY.items():
        text = text.replace(long, short)
    before = os.getcwd()
    os.chdir(folder)
    try:
        exec(compile(text, "page", "exec"), names)  # what users paste
    finally:
        os.chdir(before)


@pytest.fixture(scope="module")
def page(folder):
    names = {}
    for block in code(ROOT / "docs" / "python.md"):
        assert block.language == "python"
        executed(block.text, folder, names)
    return names


def test_the_page_runs(page, folder):
    assert len(page["losses"]) == 12 and page["maps"].color.shape[0] == 3
    assert page["picture"].dtype == np.uint8 and page["picture"].std() > 1, "the moved camera sees the scene"
    assert page["figures"].f1 > 0.9, "the mesh against itself"
    assert (folder / "site.glb").stat().st_size > 1000 and (folder / "site.spz").stat().st_size > 100
    assert json.loads((folder / "RUN-fixed" / "recipe.json").read_text())["seed"] == 7


def test_the_notebook_runs(folder):
    book = json.loads((ROOT / "examples" / "notebook.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in book["cells"] if cell["cell_type"] == "code"]
    assert len(cells) > 3
    names = {}
    for cell in cells:
        cell = cell.replace("boruszyn", "scene").replace("scale=8", "scale=1").replace("steps=300", "steps=12")
        executed("\n".join(line for line in cell.splitlines() if not line.startswith("%")), folder, names)


def test_the_same_run_as_by_the_command(page, folder, tmp_path, capsys):
    words = ["--data", str(folder / "scene"), "--out", str(tmp_path / "run"), "--steps", "12", "--test-every", "8"]
    assert main(["train", "recipe:2dgs", *words, "--scale", "1"]) == 0
    ours = surfkit.open(tmp_path / "run")
    theirs = surfkit.open(folder / "RUN")
    assert torch.equal(ours.splats.means, theirs.splats.means)
    main(["export", str(tmp_path / "run"), "--out", str(tmp_path / "by_command.spz")])
    assert (tmp_path / "by_command.spz").read_bytes() == (folder / "site.spz").read_bytes()


def test_a_camera_sees_its_target_in_the_middle(folder):
    scene = surfkit.read(folder / "scene")
    target = np.array([0.3, -0.2, 0.5])
    camera = scene.camera(target + [1.0, 2.0, 4.0], target)
    x, y, z = camera.project(torch.from_numpy(scene.frame.to_local(target[None])))[0].tolist()
    assert (x, y) == pytest.approx((camera.cx, camera.cy), abs=1e-6)
    assert z / scene.frame.scale == pytest.approx(np.linalg.norm([1.0, 2.0, 4.0]))
    above = target + [0, 0, 0.1]
    assert camera.project(torch.from_numpy(scene.frame.to_local(above[None])))[0, 1] < camera.cy, "up is up"


def test_a_step_may_stop_the_run(folder, tmp_path):
    def stop(step):
        if step.index == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        surfkit.train("2dgs", folder / "scene", tmp_path / "run", steps=12, on_step=stop)
    with pytest.raises(surfkit.BadInput, match="5 of 12"):
        _ = surfkit.open(tmp_path / "run").splats
    seen = []
    surfkit.train("2dgs", folder / "scene", tmp_path / "run", steps=12, on_step=lambda step: seen.append(step.index))
    assert seen == list(range(6, 13)), "it goes on where it stopped"


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda scene, run: surfkit.read("nowhere"), "nowhere"),
        (lambda scene, run: surfkit.read(scene, scales=2), "did you mean 'scale'"),
        (lambda scene, run: surfkit.train("sufrace", scene, "x"), "did you mean 'surface'"),
        (lambda scene, run: run.mesh(voxels=2), "no 'voxels'"),
        (lambda scene, run: run.mesh("tdsf"), "did you mean 'tsdf'"),
        (lambda scene, run: run.export("x.foo"), "known: .*ply"),
        (lambda scene, run: run.evaluate(tau=3), "tau has no effect without gt"),
        (lambda scene, run: run.evaluate(gt=run.out / "mesh.ply", taus=3), "did you mean 'tau'"),
        (lambda scene, run: run.evaluate().f1, "f1 was not measured"),
        (lambda scene, run: run.dataset.camera((0, 0, 0), (0, 0, 1)), "give another `up`"),
        (lambda scene, run: surfkit.open(scene), "no run folder"),
        (lambda scene, run: surfkit.read(scene, scale="4"), "read: scale: expected a number, got .4"),
        (lambda scene, run: surfkit.read(None), "read: expected a path, got null"),
        (lambda scene, run: surfkit.train("2dgs", scene, "x", steps=10.5), "steps: expected a whole number, got 10.5"),
        (lambda scene, run: surfkit.train("2dgs", scene, None), "out: expected a path, got null"),
        (lambda scene, run: run.mesh(triangles="300"), "mesh: triangles: expected a whole number, got .300"),
        (lambda scene, run: run.mesh(voxel_px="3"), "voxel_px: expected a number"),
        (lambda scene, run: run.evaluate(gt=run.out / "mesh.ply", tau="2"), "evaluate: tau: expected a number, got .2"),
        (lambda scene, run: run.evaluate(gt=np.zeros((3, 2)), tau=2), r"truth: expected shape \(P, 3\), got \(3, 2\)"),
        (lambda scene, run: run.evaluate(gt=5, tau=2), "truth: expected a path, got 5"),
        (lambda scene, run: surfkit.compare("no.ply", "no.ply", "x", taus=3), "did you mean 'tau'"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(page, folder, wrong, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = surfkit.open(folder / "RUN")
    with pytest.raises(surfkit.BadInput, match=said) as error:
        wrong(folder / "scene", run)
    assert "\n" not in str(error.value)


def test_what_was_measured_before_is_not_given_as_new(page, folder):
    run = surfkit.open(folder / "RUN")
    assert "geometry" in run.metrics and "geometry" not in run.evaluate().metrics


def test_a_mesh_that_the_method_made_takes_no_mesher(page, folder, monkeypatch):
    run = surfkit.open(folder / "RUN")
    ctx, made = run._loaded
    run.__dict__["_loaded"] = ctx, replace(made, mesh=object())

    def refuse(out):
        raise surfkit.BadInput("made its mesh itself")

    monkeypatch.setattr("surfkit.api.run.refuse_mesher", refuse)
    for given in ({"mesher": "tsdf"}, {"voxel_px": 2.0}):
        with pytest.raises(surfkit.BadInput, match="made its mesh itself"):
            run.mesh(**given)


def test_a_cloud_is_no_mesh(tmp_path):
    write_points(tmp_path / "cloud.ply", np.zeros((3, 3), np.float32), np.zeros((3, 3), np.uint8))
    with pytest.raises(surfkit.BadInput, match=r"cloud.ply: a cloud of points; name a mesh"):
        RunMesh.read(tmp_path / "cloud.ply")


def test_train_is_a_function_and_a_folder():
    from surfkit.train.stage import Stage

    assert callable(surfkit.train) and surfkit.train.stage.Stage is Stage


def test_points_in_memory_against_a_mesh_of_another_program(page, folder, tmp_path):
    mesh = RunMesh.read(folder / "RUN" / "mesh.ply")
    settings = {"tau": 0.5, "draws": 1, "crop": "none", "align": "none"}
    whole = surfkit.compare(mesh, folder / "RUN" / "mesh.ply", tmp_path / "whole", **settings)
    half = mesh.vertices[mesh.vertices[:, 0] < np.median(mesh.vertices[:, 0])]
    less = surfkit.compare(half, mesh, tmp_path / "half", **settings)
    assert whole.f1 > 0.99 and less.precision > 0.85 and less.recall < 0.5
    ours = surfkit.open(folder / "RUN").evaluate(gt=mesh, **settings)
    assert ours.recall > 0.95


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_a_mesh_far_from_0_is_saved_as_it_is(suffix, tmp_path):
    corners = np.array([[451000.123, 5873000.456, 50.1], [451001.1, 5873000.3, 50.2], [451000.7, 5873001.9, 50.3]])
    mesh = RunMesh(corners, np.array([[0, 1, 2]], np.int32), crs="EPSG:32633", metres=1.0)
    found = RunMesh.read(mesh.save(tmp_path / f"mesh.{suffix}"))
    assert found.vertices == pytest.approx(corners, rel=0, abs=1e-5)
    assert suffix != "ply" or (found.crs, found.metres) == ("EPSG:32633", 1.0)


def test_a_mesh_is_saved_in_formats_that_are_known_only(tmp_path):
    mesh = RunMesh(np.eye(3), np.array([[0, 1, 2]], np.int32))
    for name in ("mesh.stl", "mesh", None):
        with pytest.raises(surfkit.BadInput, match="save: expected a path|meshes are written as .ply, .obj, .glb"):
            mesh.save(None if name is None else tmp_path / name)
    assert not list(tmp_path.iterdir())
