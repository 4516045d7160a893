"""Expected errors of heights, against closed forms and against errors that are known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from needs import needs

from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.maps.precision import (
    DISAGREEMENT_SHARE,
    LEAST_RAYS,
    RAY_ERROR_PX,
    STEP_SHARE,
    Rays,
    StereoDepths,
)
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

from .shapes import UTM, grid_of, heightfield

rasterio = needs("rasterio")
FRAME = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, "EPSG:32633")
HEIGHT, FOCAL, SIDE = 50.0, 200.0, 160
GROUND = 100.0


def nadir(east, north=0.0, height=HEIGHT):
    """A view straight down from so many metres above the middle of the ground."""
    turn = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=torch.float64)
    centre = torch.from_numpy(FRAME.to_local(np.array([[UTM[0] + 10 + east, UTM[1] + 10 + north, GROUND + height]]))[0])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ centre
    return View("a.jpg", Camera(pose, FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE), Path("a.jpg"))


def depth_of(metres, sure=1.0):
    """A depth map of a level ground so many metres below."""
    inverse = torch.full((SIDE, SIDE), 1 / (metres * FRAME.scale))
    return DepthPrior(inverse, torch.full((SIDE, SIDE), float(sure)), 1.0)


def over(views, priors, heights=GROUND, gsd=0.5, pixel=0.25):
    grid = grid_of(gsd, UTM[0] + 5, UTM[1] + 5, UTM[0] + 15, UTM[1] + 15)
    rays = Rays(views, priors, FRAME, grid, pixel)
    window = next(grid.tiles(10_000))
    field = np.full((window.height + 2 * rays.margin, window.width + 2 * rays.margin), heights, float)
    return rays.over(window, field)


@pytest.mark.parametrize("base", [5.0, 20.0])
def test_two_rays_have_the_error_of_stereo(base):
    """The normal case: the error of a height is that of a parallax, depth squared over base and focal length."""
    sigma, count = over([nadir(-base / 2), nadir(base / 2)], [depth_of(HEIGHT)] * 2)
    assert (count == 2).all()
    exact = HEIGHT**2 / (base * FOCAL) * np.sqrt(2) * RAY_ERROR_PX
    middle = sigma[:, sigma.shape[1] // 2 - 1 : sigma.shape[1] // 2 + 1]
    assert middle == pytest.approx(exact, rel=1e-3)


def test_rays_that_are_off_add_their_mean_square():
    views = [nadir(-10), nadir(10)]
    sigma, count = over(views, [depth_of(HEIGHT - 0.3), depth_of(HEIGHT + 0.4)])
    plain, _ = over(views, [depth_of(HEIGHT)] * 2)
    added = np.sqrt(sigma**2 - plain**2)
    assert (count == 2).all()
    assert added == pytest.approx(DISAGREEMENT_SHARE * np.sqrt((0.3**2 + 0.4**2) / 2), rel=1e-4)


def test_what_contradicts_does_not_count():
    """Something in front, something far behind, and depths of no confidence."""
    views = [nadir(-10), nadir(10), nadir(0, 5), nadir(0, -5), nadir(3, 3)]
    priors = [depth_of(HEIGHT), depth_of(HEIGHT), depth_of(HEIGHT / 2), depth_of(2 * HEIGHT), depth_of(HEIGHT, 0.1)]
    sigma, count = over(views, priors)
    assert (count == 2).all()
    assert np.array_equal(sigma, over(views[:2], priors[:2])[0])


def test_one_ray_tells_nothing():
    sigma, count = over([nadir(-10), nadir(10)], [depth_of(HEIGHT), None])
    assert (count == 1).all() and np.isnan(sigma).all()


def test_more_rays_are_more_exact():
    two, _ = over([nadir(-10), nadir(10)], [depth_of(HEIGHT)] * 2)
    eight, _ = over([nadir(-10), nadir(10)] * 4, [depth_of(HEIGHT)] * 8)
    assert eight == pytest.approx(two / 2, rel=1e-6)


def test_a_step_counts_within_a_pixel():
    views, priors = [nadir(-10), nadir(10)], [depth_of(HEIGHT)] * 2
    grid = grid_of(0.5, UTM[0] + 5, UTM[1] + 5, UTM[0] + 15, UTM[1] + 15)
    rays = Rays(views, priors, FRAME, grid, 0.5)
    field = np.full((20 + 2 * rays.margin,) * 2, GROUND)
    field[:, 10 + rays.margin :] -= 0.4
    sigma, _ = rays.over(next(grid.tiles(100)), field)
    within = STEP_SHARE * 0.4 / 2  # cells are of two pixels
    assert (sigma[:, 9:11] > within).all()
    assert (sigma[:, :9] < within).all() and (sigma[:, 11:] < within).all()


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_maps_of_pixels_three_times_as_large_are_a_third_as_exact(slope):
    """Stereo at a third of the size: in all parts of the error but what the rays themselves show."""
    views, prior = [nadir(-10), nadir(10)], depth_of(HEIGHT)
    grid = grid_of(0.5, UTM[0] + 5, UTM[1] + 5, UTM[0] + 15, UTM[1] + 15)
    field = GROUND + slope * 0.001 * np.arange(30)[None] + np.zeros((30, 1))
    sigma = []
    for coarseness in (1.0, 3.0):
        rays = Rays(views, [replace(prior, coarseness=coarseness)] * 2, FRAME, grid, 0.5)
        sigma.append(rays.over(next(grid.tiles(100)), field[: 20 + 2 * rays.margin, : 20 + 2 * rays.margin])[0])
    assert sigma[1] == pytest.approx(3 * sigma[0], rel=2e-3)


def test_what_one_of_larger_pixels_may_contradict():
    views, far = [nadir(-10), nadir(10)], depth_of(HEIGHT + 1)  # of pixels of 0.25 m, four
    assert (over(views, [far, far])[1] == 0).all()
    assert (over(views, [replace(far, coarseness=2.0)] * 2)[1] == 2).all()


def hilly(x, y):
    return GROUND + np.sin(x - UTM[0]) + 0.3 * (y - UTM[1])


def maps(out, tile, priors):
    views = [nadir(-12), nadir(12), nadir(0, 12)]
    surface = heightfield(hilly, UTM, (UTM[0] + 20, UTM[1] + 20), 81)
    settings = MapSettings(("precision",), 0.25, tile=tile)
    record = make_maps(MeshWithPhotos(surface, FRAME, views), settings, out, depths=StereoDepths(priors, "a"))
    return record["precision"], *(rasterio.open(out / name).read(1) for name in ("precision.tif", "rays.tif"))


def test_the_tiles_do_not_show(tmp_path):
    priors = [depth_of(HEIGHT - 3), depth_of(HEIGHT - 3), depth_of(HEIGHT - 5)]
    whole, small = maps(tmp_path / "whole", 512, priors), maps(tmp_path / "small", 33, priors)
    assert whole[0] == small[0] and 0 < whole[0]["known"] < 1
    assert np.array_equal(whole[1], small[1]) and np.array_equal(whole[2], small[2])
    known = whole[1] != -9999
    assert (whole[2][known] >= LEAST_RAYS).all() and (whole[2][~known] < LEAST_RAYS).all()
    assert whole[0]["median"] == pytest.approx(np.median(whole[1][known]), rel=0.02)


def test_errors_that_are_drawn_at_random_are_foretold(tmp_path):
    """Two rays with an error of a pixel's share each: as many heights within one and two standard deviations as of
    normal errors, where nothing else is wrong."""
    draw, views = np.random.default_rng(3), [nadir(-10), nadir(10)]
    sigma, _ = over(views, [depth_of(HEIGHT)] * 2)
    parallax = draw.normal(0, RAY_ERROR_PX, (2, *sigma.shape))
    errors = HEIGHT**2 / (20 * FOCAL) * (parallax[0] - parallax[1])
    assert np.mean(np.abs(errors) < sigma) == pytest.approx(0.683, abs=0.05)


def test_volumes_have_the_error_that_the_precision_implies(tmp_path):
    needs("pyogrio")
    corners = [
        [UTM[0] + 8, UTM[1] + 8],
        [UTM[0] + 12, UTM[1] + 8],
        [UTM[0] + 12, UTM[1] + 12],
        [UTM[0] + 8, UTM[1] + 12],
    ]
    shape = {"type": "Polygon", "coordinates": [[*corners, corners[0]]]}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    items = {
        "type": "FeatureCollection",
        "crs": crs,
        "features": [{"type": "Feature", "properties": {}, "geometry": shape}],
    }
    (tmp_path / "a.geojson").write_text(json.dumps(items))
    settings = MapSettings(("precision",), 0.25, volume=tmp_path / "a.geojson", base=90.0)
    surface = heightfield(hilly, UTM, (UTM[0] + 20, UTM[1] + 20), 81)
    views, depths = [nadir(-12), nadir(12)], StereoDepths([depth_of(HEIGHT - 3)] * 2, "a")
    record = make_maps(MeshWithPhotos(surface, FRAME, views), settings, tmp_path / "maps", depths=depths)
    found = record["volumes"]["polygons"][0]
    with rasterio.open(tmp_path / "maps/precision.tif") as file:
        west, _, _, north = file.bounds
        column, row = round((UTM[0] + 8 - west) / 0.25), round((north - UTM[1] - 12) / 0.25)
        part = file.read(1, masked=True)[row : row + 16, column : column + 16]
    assert 0 < part.mask.mean() < 1
    assert found["surface_error"] == pytest.approx(0.25**2 * part.sum(), rel=1e-5)
    assert found["without_precision"] == pytest.approx(part.mask.mean())


def test_without_depth_maps_there_is_none(tmp_path):
    surface = heightfield(hilly, UTM, (UTM[0] + 20, UTM[1] + 20))
    with pytest.raises(BadInput, match="--products precision: the run has no depth maps"):
        make_maps(MeshWithPhotos(surface, FRAME, [nadir(0)]), MapSettings(("precision",), 0.25), tmp_path / "maps")
    assert not (tmp_path / "maps").exists()
