"""Splats in Python: edited, written and read again, and drawn with gradients."""

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from models import data_set

import surfkit
from surfkit.io.splats.page import HtmlPageFormat


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("splats")
    scene = surfkit.read(data_set(folder / "scene"))
    return surfkit.train("2dgs", scene, folder / "run", steps=4)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".splat", ".glb"])
def test_edited_splats_are_written_and_read_again(run, tmp_path, suffix):
    splats = run.splats
    above = splats.take(splats.means[:, 2] > splats.means[:, 2].median())
    red = replace(above, sh0=torch.tensor([1.0, -1.0, -1.0]).expand(len(above), 3), sh_rest=above.sh_rest[:, :0])
    again = surfkit.read_splats(surfkit.save_splats(red, tmp_path / f"red{suffix}"))
    assert len(again) == len(above) and again.sh0.mean(0).tolist() == pytest.approx([1, -1, -1], abs=0.05)
    assert again.means.mean(0).tolist() == pytest.approx(above.means.mean(0).tolist(), abs=0.05)


def test_axes_that_a_file_does_not_say_are_told_and_set(run, tmp_path, capsys):
    file = surfkit.save_splats(run.splats, tmp_path / "red.spz")
    capsys.readouterr()
    guessed = surfkit.read_splats(file)
    assert 'is assumed; axes="rdf" takes them as those of a PLY file' in capsys.readouterr().err
    turned = surfkit.read_splats(file, axes="rdf")
    assert not capsys.readouterr().err
    assert torch.allclose(turned.means, guessed.means * torch.tensor([1.0, -1.0, -1.0]))
    with pytest.raises(surfkit.BadInput, match="read_splats: axes"):
        surfkit.read_splats(file, axes="north")


def test_splats_are_drawn_as_the_run_draws_them(run):
    scene, camera = run.dataset, run.dataset.held_out[0]
    ours, theirs = scene.draw(run.splats, camera), run.render(camera)
    for name in ("color", "depth", "median", "normal"):
        assert torch.allclose(getattr(ours, name), getattr(theirs, name), atol=1e-3), name


@pytest.mark.parametrize(
    ("name", "rel"), [("sh0", 0.01), ("opacity_logits", 0.05), ("log_scales", 0.2), ("means", 0.05)]
)
def test_gradients_are_those_of_finite_differences(run, name, rel):
    """Larger splats also end farther out, where what is fainter than 1 / 255 is not drawn: no gradient knows that."""
    scene, camera = run.dataset, run.dataset.train[0]
    draw = torch.Generator().manual_seed(0)
    value = getattr(run.splats, name)
    weight = torch.rand(run.render(camera).color.shape, generator=draw)

    def loss(given):
        return (scene.draw(replace(run.splats, **{name: given}), camera).color.double() * weight).sum()

    leaf = value.clone().requires_grad_()
    loss(leaf).backward()
    along = leaf.grad.sign()
    step = 1e-3
    with torch.no_grad():
        change = (loss(value + step * along) - loss(value - step * along)) / (2 * step)
    assert float(change) == pytest.approx(float((leaf.grad * along).sum()), rel=rel)


def test_colours_are_fitted_in_a_loop_of_ones_own(run):
    scene, view = run.dataset, run.dataset.train[0]
    wanted = torch.full_like(run.render(view).color, 0.25)
    sh0 = run.splats.sh0.clone().requires_grad_()
    optimizer, errors = torch.optim.Adam([sh0], lr=0.1), []
    for _ in range(8):
        optimizer.zero_grad()
        error = (scene.draw(replace(run.splats, sh0=sh0), view).color - wanted).abs().mean()
        error.backward()
        optimizer.step()
        errors.append(float(error))
    assert errors[-1] < 0.7 * errors[0]


def test_a_script_may_end_with_a_graph_in_its_hands(run):
    script = (
        f"import surfkit, dataclasses; run = surfkit.open({str(run.out)!r}); splats = run.splats;"
        "sh0 = splats.sh0.requires_grad_(); view = run.dataset.train[0];"
        "maps = run.dataset.draw(dataclasses.replace(splats, sh0=sh0), view)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and not done.stdout + done.stderr


def test_a_run_goes_to_another_process(run):
    again = pickle.loads(pickle.dumps(run))
    assert again.out == run.out and torch.equal(again.splats.means, run.splats.means)


def test_a_data_set_is_one_line(run):
    assert len(repr(run.dataset)) < 200 and "held out" in repr(run.dataset)


def test_the_steps_of_a_run(run):
    assert [step["index"] for step in run.steps] == [1, 2, 3, 4] and run.steps[0]["losses"]["l1"] > 0


def test_a_camera_of_another_size_and_angle(run):
    scene = run.dataset
    target = scene.points.mean(0)
    camera = scene.camera(target + [1, 2, 4], target, size=(64, 20), fov=90)
    assert (camera.width, camera.height, camera.fx, camera.cx) == (64, 20, pytest.approx(32), 32)
    assert run.render(camera).color.shape == (3, 20, 64)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda run, scene, at: scene.camera([1, 2], at), r"camera: position: expected shape \(3,\), got \(2,\)"),
        (lambda run, scene, at: scene.camera([np.nan] * 3, at), "camera: position is .*give finite values"),
        (lambda run, scene, at: scene.camera(at, at), "position and target are both"),
        (lambda run, scene, at: scene.camera(at + [1, 2, 4], at, fov=180), "fov 180: give .* 0 to 180 degrees"),
        (lambda run, scene, at: scene.camera(at + [1, 2, 4], at, size=(64,)), "camera: size: expected 2 values, got 1"),
        (
            lambda run, scene, at: run.render(np.eye(4)),
            "expected a view of the data set or a surfkit.Camera, got ndarr",
        ),
        (lambda run, scene, at: scene.draw(run.splats, None), "got NoneType"),
        (lambda run, scene, at: scene.draw(run, scene.train[0]), "expected splats .* got TrainedRun"),
        (lambda run, scene, at: surfkit.save_splats(run, "x.ply"), "expected splats .* got TrainedRun"),
        (lambda run, scene, at: surfkit.save_splats(run.splats, "x.xyz"), "no format of splats has this suffix"),
        (lambda run, scene, at: surfkit.read_splats("nowhere.ply"), "nowhere.ply"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(run, wrong, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(surfkit.BadInput, match=said) as error:
        wrong(run, run.dataset, run.dataset.points.mean(0))
    assert "\n" not in str(error.value)


def test_what_an_export_leaves_out_is_told(run, tmp_path, capsys):
    run.export(tmp_path / "page.html", HtmlPageFormat(max_splats=10))
    assert "the 10 of " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda run: replace(run.splats, sh0=run.splats.sh0.numpy()), "sh0: expected a tensor, got ndarray"),
        (lambda run: replace(run.splats, kind="surfels"), "kind is 'surfels'; splats are of the kind surfel or gau"),
        (lambda run: run.dataset.photo(run.dataset.train[0].camera), "expected a view of the data set, .* got Camera"),
        (lambda run: run.export(5), "export: expected a path, got 5"),
        (lambda run: run.export("a.ply", 5), "export: format: expected a Format, or the name of one, got 5"),
        (lambda run: surfkit.save_splats(run.splats, "a.ply", 5), "save_splats: format: expected a Format"),
        (lambda run: run.mesh(memory=5), "mesh: memory: expected text, got 5"),
        (lambda run: surfkit.train("2dgs", run.dataset, "x", cache=5), "cache: expected text, got 5"),
    ],
)
def test_values_of_another_type_are_told(run, wrong, said):
    with pytest.raises(surfkit.BadInput, match=said) as error:
        wrong(run)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", [".ply", ".sog", ".compressed.ply", ".glb"])
def test_survey_coordinates_are_kept_without_a_frame(run, tmp_path, capsys, suffix):
    splats = run.splats
    far = torch.tensor([451000.123, 5873000.456, 50.0], dtype=torch.float64)
    path = surfkit.save_splats(replace(splats, means=splats.means + far), tmp_path / f"far{suffix}")
    assert "leave out the offset" in capsys.readouterr().err
    low, high = (getattr(surfkit.read_splats(path).means, end)(0).values for end in ("min", "max"))
    assert (low - far - splats.means.min(0).values).abs().max() < 0.01
    assert (high - far - splats.means.max(0).values).abs().max() < 0.01
