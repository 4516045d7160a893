"""Orthophotos from photographs of a scene whose colours are known everywhere."""

from dataclasses import replace

import numpy as np
import pytest
from flown_ground import flown_ground, ground
from needs import needs
from PIL import Image
from town import BOX, HALF, HIDDEN, YELLOW, town, truth

from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.maps.photo_sight import between
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.scene.srgb import from_linear, linear

rasterio = needs("rasterio")
needs("cv2")
SETTINGS = MapSettings(products=("orthophoto",), colors="photographs", gsd=0.1, up="z", memory="100MB", tile=64)


def orthophoto(scene, out, settings=SETTINGS):
    """What maps.json says; (H, W, 3) colours, (H, W) alpha, and (H, W, 3) places of the centres."""
    record = make_maps(MeshWithPhotos(scene.surface, scene.frame, scene.views), settings, out)
    with rasterio.open(out / "orthophoto.tif") as file:
        *colors, alpha = file.read()
    west, _, _, north = record["bounds"]
    row, column = np.indices(alpha.shape) + 0.5
    places = np.stack([west + column * record["gsd"], north - row * record["gsd"], np.zeros(row.shape)], -1)
    return record, np.stack(colors, -1).astype(float), alpha, places


def on_roof(places, margin=0.0):
    low, high = np.array(BOX.low[:2]) - margin, np.array(BOX.high[:2]) + margin
    return ((places[..., :2] > low) & (places[..., :2] < high)).all(-1)


def exact(places):
    roof = on_roof(places)
    high = np.where(roof, BOX.high[2], 0.0)
    at = np.stack([places[..., 0], places[..., 1], high], -1)
    return 255 * truth(at.reshape(-1, 3), roof.ravel()).reshape(at.shape)


def test_cells_have_the_colors_of_the_surface(tmp_path):
    exposures = np.exp(0.15 * np.random.default_rng(1).normal(size=12))
    scene = town(tmp_path, exposures=exposures / np.exp(np.log(exposures).mean()), car=3)
    record, colors, alpha, places = orthophoto(scene, tmp_path / "maps")
    inner = (np.abs(places[..., :2]) < HALF - 0.3).all(-1)
    assert (alpha[inner] == 255).all() and record["orthophoto"]["from_photographs"] > 0.9
    away = np.abs(colors - exact(places)).max(-1)
    clear = inner & (on_roof(places, 0.3) == on_roof(places, -0.3))
    photographed = np.abs(colors - HIDDEN).max(-1) > 2
    assert photographed[clear].mean() > 0.97
    # between whole triangles only: some at the foot of the box are seen in part
    assert np.percentile(away[clear & photographed], 99) < 10 and away[clear & photographed].max() < 40
    assert (np.abs(colors - 255 * YELLOW).max(-1) > 60).all(), "the car"


def test_the_tiles_do_not_show(tmp_path):
    scene = town(tmp_path)
    one, other = (orthophoto(scene, tmp_path / str(tile), replace(SETTINGS, tile=tile))[1] for tile in (32, 512))
    assert np.array_equal(one, other)
    assert np.array_equal(*(numbers_of(tmp_path / str(tile)) for tile in (32, 512)))


def test_the_mesh_has_the_rest(tmp_path):
    """A photograph of a corner only."""
    scene = town(tmp_path)
    record, colors, _, _ = orthophoto(replace(scene, views=scene.views[:1]), tmp_path / "maps")
    assert 0.1 < record["orthophoto"]["from_photographs"] < 0.9
    small = orthophoto(replace(scene, views=scene.views[:1]), tmp_path / "small", replace(SETTINGS, tile=16))[1]
    assert np.array_equal(small, colors), "some tiles have no cell that a photograph shows"
    from_mesh = np.abs(colors - HIDDEN).max(-1) <= 1
    assert from_mesh.mean() == pytest.approx(1 - record["orthophoto"]["from_photographs"], abs=0.03)


def test_colors_between_pixels_are_linear():
    row, column = np.indices((6, 8)) + 0.5
    photo = np.stack([3 * column + 5 * row, column, 100 + row]).astype(np.float64)
    x, y = np.random.default_rng(0).uniform((0.5, 0.5), (7.5, 5.5), (50, 2)).T
    assert np.allclose(between(photo, x, y), np.stack([3 * x + 5 * y, x, 100 + y], 1))


@pytest.mark.parametrize("odd", [0.6, 1.5])
def test_colors_are_those_of_the_mean_exposure_and_not_clipped(tmp_path, odd):
    """A third of the photographs is much darker, or much brighter and clipped, than the others."""
    exposures = np.where(np.arange(12) % 3 == 1, odd, 1.0)
    scene = town(tmp_path, exposures=exposures)
    _, colors, _, places = orthophoto(scene, tmp_path / "maps")
    inner = (np.abs(places[..., :2]) < HALF - 0.3).all(-1) & (on_roof(places, 0.3) == on_roof(places, -0.3))
    clear = inner & (np.abs(colors - HIDDEN).max(-1) > 2)
    mean = np.exp(np.log(exposures).mean())
    true = 255 * from_linear(mean * linear(exact(places)[clear] / 255))
    ratio = (colors[clear] / true)[(true > 60) & (true < 200)]
    assert abs(np.median(ratio) - 1) < 0.02 and np.percentile(np.abs(ratio - 1), 95) < 0.06
    photographs = [np.asarray(Image.open(view.path)) for view in scene.views]
    white = np.mean([(photo >= 250).any(-1).mean() for photo in photographs])
    assert (colors[clear] >= 250).any(-1).mean() <= white + 0.005


@pytest.mark.parametrize("seed", [0, 1])
def test_a_survey_in_changing_light_gives_the_ground_without_seams(tmp_path, seed):
    """Exposures of one stop up and down, white balance of 15 % and dark corners, against the exact ground."""
    scene = flown_ground(tmp_path, seed=seed)
    settings = replace(SETTINGS, gsd=0.06, tile=512)
    record, colors, alpha, places = orthophoto(scene, tmp_path / "maps", settings)
    inner = (np.abs(places[..., :2]) < 8).all(-1) & (np.abs(colors - HIDDEN).max(-1) > 3) & (alpha == 255)
    assert inner.mean() > 0.7 and record["orthophoto"]["from_photographs"] > 0.9
    light = 0.9 * ground(places[..., 0], places[..., 1])
    factor = np.exp(np.log(linear(colors[inner] / 255) / light[inner]).mean(0))  # gains are known up to one
    true, plain = 255 * from_linear((factor * light).clip(0, 1)), inner & (light.max(-1) < 0.5)
    away = np.abs(colors - true)
    assert np.median(away[plain]) < 1.0 and np.percentile(away[plain], 95) < 2.5
    white = np.mean([(np.asarray(Image.open(view.path)) >= 250).any(-1).mean() for view in scene.views])
    assert (colors[inner] >= 250).any(-1).mean() < 1.5 * white
    # across cut lines the steps are those of the ground
    step, exact_step = steps_at_seams(tmp_path / "maps", colors, np.where(plain[..., None], true, np.nan))
    assert step < exact_step + 1


def numbers_of(out):
    """(H, W) number of the photograph of each cell, from 1; 0 for none."""
    with rasterio.open(out / "orthophoto-photographs.tif") as file:
        return file.read(1).astype(int)


def steps_at_seams(out, colors, true):
    """Mean difference of colours that neighbouring cells of two photographs have, and that they should have."""
    photo, steps = numbers_of(out), []
    for axis in (0, 1):
        seam = np.diff(photo, axis=axis) != 0
        steps.append(np.stack([np.abs(np.diff(each, axis=axis)).mean(-1)[seam] for each in (colors, true)]))
    found = np.concatenate(steps, axis=1)
    found = found[:, np.isfinite(found).all(0)]
    assert found.shape[1] > 200
    return found.mean(1)
