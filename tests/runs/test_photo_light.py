from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from two_blocks import EVERY, STEPS, stop_after

from surfkit.appearance import CameraResponse
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.partition import PictureShare, QuantileGrid
from surfkit.raster.psnr import psnr
from surfkit.runs import photo_light, pipeline
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.folder import Run
from surfkit.runs.photo_light import LightRecord, _photo_light, held_out_response, light_of, recorded
from surfkit.runs.pipeline import load_run, loaded, opened, run
from surfkit.runs.recipe import Recipe
from surfkit.runs.start import InitialPointBuilder
from surfkit.scene.photos import view_photo
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import TrackColors
from surfkit.scene.track_light import TrackLight
from surfkit.testing.synthetic import Flight, photograph, write_colmap
from surfkit.train import checkpoint
from surfkit.train.data_cache import TrainingData
from surfkit.train.refine.light_gaussian import DistilSH, PruneAndRecover
from surfkit.train.stage import Stage

NOTHING = TrackColors(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 3)))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Photographs of changing exposure, with tracks."""
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder, photograph(Flight(views=16, width=64, height=48, points=600)), tracks=True)
    for at, path in enumerate(sorted((folder / "images").iterdir())):
        light = linear(np.asarray(Image.open(path)) / 255) * 2.0 ** ((-1) ** at * 0.5)
        Image.fromarray((from_linear(light.clip(0, 1)) * 255).round().astype(np.uint8)).save(path)
    return Data(folder, test_every=0)


@pytest.fixture
def recipe():
    return Recipe(pretrain=Stage(steps=STEPS, sh_every=1_000, appearance=CameraResponse()))


def test_a_run_finds_exposures_first_and_resumes_with_the_same_bits(data, recipe, tmp_path, monkeypatch):
    run(recipe, data, tmp_path / "whole", Compute("cpu"), EVERY)
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "optimise", stop_after(pipeline.optimise, 5))
        with pytest.raises(KeyboardInterrupt):
            run(recipe, data, tmp_path / "halves", Compute("cpu"), EVERY)
    (tmp_path / "halves/light.json").unlink()  # the numbers are in the checkpoint
    run(recipe, data, tmp_path / "halves", Compute("cpu"), EVERY)
    states = [load_run(tmp_path / name)[1] for name in ("whole", "halves")]
    assert all(torch.equal(value, states[1].points.params[name]) for name, value in states[0].points.params.items())
    assert torch.equal(states[0].appearances["value"], states[1].appearances["value"])

    record = read_json(tmp_path / "whole/light.json", LightRecord)
    stops = np.array([record.photographs[view.name].stops for view in read(data).train])
    off = stops - 0.5 * (-1.0) ** np.arange(len(stops))[:, None]
    assert np.abs(off - off.mean(0)).max() < 0.15 and np.abs(stops.mean(0)).max() < 1e-9
    assert list(record.cameras) == ["camera 1"] and record.cameras["camera 1"].curve == (0, 0, 0)
    value, mean = states[0].appearances["value"], record.cameras["camera 1"].mean
    assert torch.allclose(value[:, :3].double(), torch.from_numpy(stops + mean)) and value.shape == (len(stops), 11)


def test_points_begin_with_colours_in_one_light(data, recipe, tmp_path):
    run(recipe, data, tmp_path / "run", Compute("cpu"), EVERY)
    scene = read(data)
    given = TrainingData([view_photo(view) for view in scene.train], None, None)
    builder = InitialPointBuilder(Run(tmp_path / "run", recipe, data), scene, given, None)
    raw, even = (torch.stack([photo.float().mean() for photo in each]) for each in (given.photos, builder.photos()))
    assert (raw[::2].mean() / raw[1::2].mean()).item() > 1.2  # a stop between them
    assert (even[::2].mean() / even[1::2].mean()).item() == pytest.approx(1, abs=0.05)
    plain = replace(recipe, pretrain=replace(recipe.pretrain, appearance=None))
    builder = InitialPointBuilder(Run(tmp_path / "run", plain, data), scene, given, None)
    assert builder.photos() is given.photos


def test_blocks_have_the_numbers_of_the_whole_scene(data, recipe, tmp_path):
    tune = replace(recipe.pretrain, steps=STEPS)
    recipe = replace(
        recipe,
        pretrain=replace(tune, appearance=None),
        partition=QuantileGrid((2, 1)),
        assign=PictureShare(),
        tune=tune,
    )
    run(recipe, data, tmp_path, Compute("cpu"), EVERY)
    opened_run, scene = opened(tmp_path), read(data)
    whole = dict(zip([view.name for view in scene.train], light_of(opened_run, scene.train).stops, strict=True))
    found = 0
    for folder in sorted((tmp_path / "blocks").glob("0*")):
        state = checkpoint.load_last(folder / "tune/checkpoint.safetensors")[0]
        with np.load(folder / "views.npz") as file:
            names = [name for name in whole if f'"{name}"' in str(file["facts"])]
        assert torch.equal(state.appearances["value"][:, :3], torch.stack([whole[name] for name in names]))
        found += 1
    assert found == 2
    assert torch.equal(load_run(tmp_path)[1].appearances["value"][:, :3], torch.stack(list(whole.values())))


def test_without_tracks_it_is_refused_before_anything_is_written(recipe, tmp_path):
    write_colmap(tmp_path / "data", photograph(Flight(views=6, width=32, height=24, points=60)))
    with pytest.raises(BadInput, match="camera-response needs the sparse points .*prepare points.*appearance:exposure"):
        run(recipe, Data(tmp_path / "data", test_every=0), tmp_path / "run", Compute("cpu"), EVERY)
    assert not (tmp_path / "run/run.json").exists()


def test_numbers_that_are_gone_are_named(data, recipe, tmp_path):
    run(replace(recipe, pretrain=replace(recipe.pretrain, steps=1)), data, tmp_path, Compute("cpu"), EVERY)
    scene = read(data)
    stranger = replace(scene.train[0], name="stranger.png")
    with pytest.raises(BadInput, match="light.json: it lacks 'stranger.png'; delete it"):
        light_of(opened(tmp_path), [scene.train[1], stranger])


@pytest.mark.parametrize("falloff", [(1.0, 0.0, 0.0), (-0.7, 0.2, 0.0)])
def test_the_scene_is_as_bright_as_the_mean_photograph(data, falloff):
    """A fit may centre the vignetting far from the middle, where what it takes from the middle means nothing."""
    views = read(data).train
    stops = np.array([[0.5, 0.5, 0.5], [-0.5, -0.5, -0.5]] * (len(views) // 2))
    light = TrackLight(
        stops, np.array([[*falloff, -0.8, -0.5, 0, 0, 0]]), np.zeros((3, 3)), np.full(len(views), 99), 0.01
    )
    record = recorded(light, views)
    grey = torch.full((3, 48, 64), 0.3)
    model, known = (
        CameraResponse(),
        _photo_light(
            [record.photographs[view.name].stops for view in views], [record.cameras[view.taken_by] for view in views]
        ),
    )
    taken = [model(numbers, grey, view.camera) for numbers, view in zip(model.begin_with(known), views, strict=True)]
    ratio = [np.log2(linear(each.numpy().astype(np.float64)) / linear(0.3)).mean() for each in taken]
    assert np.mean(ratio) == pytest.approx(0, abs=2e-3) and np.ptp(ratio) == pytest.approx(1, abs=1e-3)


def test_light_of_earlier_versions_is_taken_as_it_was(data, tmp_path):
    record = recorded(
        TrackLight(np.zeros((1, 3)), np.array([[1.0, *[0.0] * 7]]), np.zeros((3, 3)), np.array([99]), 0.01),
        read(data).train[:1],
    )
    assert record.cameras["camera 1"].mean == pytest.approx(1 / 3, rel=0.02)  # the mean of r^2
    before = asdict(record)
    del before["cameras"]["camera 1"]["mean"]
    write_json(tmp_path / "light.json", before)
    assert read_json(tmp_path / "light.json", LightRecord).cameras["camera 1"].mean == 0


def test_uneven_light_is_told_where_no_stage_learns_it(data, recipe, tmp_path, capsys):
    short = replace(recipe.pretrain, steps=1, appearance=None)
    run(replace(recipe, pretrain=short), data, tmp_path / "plain", Compute("cpu"), EVERY)
    told = capsys.readouterr().err
    assert "exposures differ by 1.0 stops" in told and "add pretrain.appearance:camera-response" in told
    run(replace(recipe, pretrain=short), data, tmp_path / "plain", Compute("cpu"), EVERY)
    assert "exposures differ" not in capsys.readouterr().err, "of a finished run"
    run(replace(recipe, pretrain=replace(short, appearance=CameraResponse())), data, tmp_path / "with", Compute("cpu"))
    told = capsys.readouterr().err
    assert "add pretrain.appearance" not in told and "light of the photographs: exposures differ by 1.0 stops" in told


def test_of_many_photographs_some_are_looked_at(data, recipe, monkeypatch):
    looked = []
    monkeypatch.setattr(photo_light, "track_colors", lambda views, tracks: looked.append(views) or NOTHING)
    monkeypatch.setattr(photo_light, "GROUPS", 2)
    monkeypatch.setattr(photo_light, "GROUP", 3)
    plain = replace(recipe, pretrain=replace(recipe.pretrain, appearance=None))
    scene = read(data)
    photo_light.warn_of_light(Run(data.path / "run", plain, data), scene)
    names, tracks = [view.name for view in scene.train], observations(data, scene).seen
    shown = {name: {*tracks[name].points.tolist()} for name in names}
    wanted: list[str] = []
    for first in (names[0], names[-1]):
        rest = [name for name in names if name not in wanted]
        wanted += sorted(rest, key=lambda name: -len(shown[name] & shown[first]))[:3]
    assert [view.name for view in looked[0]] == sorted(wanted) and len(wanted) == 6


def test_even_light_changes_nothing_where_only_uneven_light_is_looked_for(data, recipe, tmp_path, capsys):
    even = tmp_path / "even"
    write_colmap(even, photograph(Flight(views=9, width=64, height=48, points=400)), tracks=True)
    looks = replace(recipe.pretrain, steps=3, appearance=CameraResponse("uneven"))
    made = {}
    for name, stage in {"looks": looks, "plain": replace(looks, appearance=None)}.items():
        run(replace(recipe, pretrain=stage), Data(even, test_every=3), tmp_path / name, Compute("cpu"), EVERY)
        made[name] = load_run(tmp_path / name)[1]
        if name == "looks":
            assert "that is little, so colours stay as they are" in capsys.readouterr().err
    record = read_json(tmp_path / "looks/light.json", LightRecord)
    assert not record.is_used and not record.photographs and 0 < record.spread.stops < 0.5
    told = read_json(tmp_path / "looks/run.json", dict[str, Any])["light"]
    assert told == {"is_used": False, **asdict(record.spread)}
    assert "light" not in read_json(tmp_path / "plain/run.json", dict[str, Any])
    assert not made["looks"].appearances
    same = made["plain"].points.params.items()
    assert all(torch.equal(value, made["looks"].points.params[name]) for name, value in same)

    run(replace(recipe, pretrain=looks), data, tmp_path / "uneven", Compute("cpu"), EVERY)
    assert read_json(tmp_path / "uneven/light.json", LightRecord).is_used
    assert load_run(tmp_path / "uneven")[1].appearances["value"].abs().max() > 0.4


def test_light_that_is_uneven_in_some_photographs_alone_changes_nothing(data, recipe, tmp_path, monkeypatch, capsys):
    """All are looked at before colours are changed in all: a few tell response curves badly."""
    monkeypatch.setattr(photo_light, "sampled_by_tracks", lambda views, tracks: views[:5])
    looked = []

    def fit(views, tracks):
        looked.append(len(views))
        stops = np.linspace(-1, 1, len(views))[:, None] * (1.0 if len(views) == 5 else 0.1) * np.ones(3)
        return TrackLight(stops, np.zeros((1, 8)), np.zeros((3, 3)), np.full(len(views), 99), 0.01)

    monkeypatch.setattr(photo_light, "light_by_tracks", fit)
    looks = replace(recipe, pretrain=replace(recipe.pretrain, appearance=CameraResponse("uneven")))
    found = photo_light.needed_light(Run(tmp_path, looks, data), read(data))
    assert looked == [5, 16] and not found.is_used and found.spread.stops == pytest.approx(0.16)
    assert "differ by 0.2 stops" in capsys.readouterr().err


def test_without_tracks_light_that_is_only_looked_for_is_not_known(recipe, tmp_path, capsys):
    write_colmap(tmp_path / "data", photograph(Flight(views=6, width=32, height=24, points=60)))
    stage = replace(recipe.pretrain, steps=2, appearance=CameraResponse("uneven"))
    run(replace(recipe, pretrain=stage), Data(tmp_path / "data", test_every=0), tmp_path / "run", Compute("cpu"), EVERY)
    assert "light of the photographs: not known" in capsys.readouterr().err
    record = read_json(tmp_path / "run/light.json", LightRecord)
    assert not record.is_used and record.spread is None


def test_held_out_photographs_are_drawn_as_their_camera_takes_them(recipe, tmp_path):
    """Dark corners of the training photographs are those of held-out ones: renders have them too."""
    folder = tmp_path / "dark"
    write_colmap(folder, photograph(Flight(views=16, width=64, height=48, points=600)), tracks=True)
    y, x = (np.indices((48, 64)) + 0.5 - np.array([24, 32])[:, None, None]) / 40  # halves of the diagonal
    for path in (folder / "images").iterdir():
        light = linear(np.asarray(Image.open(path)) / 255) * 2.0 ** -(1.5 * (x * x + y * y))[..., None]
        Image.fromarray((from_linear(light.clip(0, 1)) * 255).round().astype(np.uint8)).save(path)
    stage = replace(recipe.pretrain, steps=2, appearance=CameraResponse("uneven"))
    run(replace(recipe, pretrain=stage), Data(folder, test_every=4), tmp_path / "run", Compute("cpu"), EVERY)
    with loaded(tmp_path / "run", "cpu") as (ctx, made):
        view = ctx.scene.held_out[0]
        plain, taken = (draw(view).need("color") for draw in (made.draw, made.photographed(made.draw)))
        stops = np.log2(linear(taken.numpy()).clip(1e-6) / linear(plain.numpy()).clip(1e-6))
        assert np.abs(stops[:, 24, 32] - 0.5).max() < 0.1 and -1.5 < np.median(stops[:, 0, 0]) < -0.5  # 0 on average
        wanted, photo = read_json(tmp_path / "run/metrics.json", dict[str, Any]), view_photo(view).float() / 255
        assert wanted["images"]["per_image"][view.name]["psnr"] == pytest.approx(psnr(taken.clamp(0, 1), photo), 1e-4)
        other = made.photographed(made.draw)(replace(view, taken_by="as a later version calls it")).need("color")
        assert torch.equal(other, taken), "known by the folder"


def test_a_model_has_the_light_of_the_stage_that_saw_photographs(data, recipe, tmp_path):
    """One that learns from renders does not; one that is refined on photographs as they are has theirs."""
    short = replace(recipe, pretrain=replace(recipe.pretrain, steps=1))
    run(short, data, tmp_path, Compute("cpu"), EVERY)
    refined = Run(tmp_path, replace(short, refine=(DistilSH(), PruneAndRecover())), data)
    found = {stage.name: held_out_response(refined, stage) for stage in refined.stages}
    assert found["pretrain"] is not None and found["refine0"] is not None and found["refine1"] is None
