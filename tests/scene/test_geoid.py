"""The height of the geoid, from grids and numbers, against PROJ's own interpolation and a plane."""

import numpy as np
import pyproj
import pytest
from grids import plane, write_gtx
from needs import needs

from surfkit.core.check import BadInput
from surfkit.scene.geoid import geoid_of

LATITUDE, LONGITUDE = np.array([53.01, 52.1, 50.0]), np.array([8.27, 7.33, 5.0])


def test_a_number_is_the_height_everywhere():
    assert geoid_of("-17.5")(LATITUDE, LONGITUDE).tolist() == [-17.5] * 3


def test_a_gtx_file_gives_what_proj_makes_of_it(tmp_path):
    needs("rasterio")
    path = write_gtx(tmp_path / "own geoid.gtx", values=lambda a, b: plane(a, b) + np.sin(3 * a) * np.cos(5 * b))
    found = geoid_of(str(path))(LATITUDE, LONGITUDE)
    steps = f'+step +proj=vgridshift +grids="{path}" +multiplier=1'
    turn = "+step +proj=unitconvert +xy_in={} +xy_out={}".format
    proj = pyproj.Transformer.from_pipeline(f"+proj=pipeline {turn('deg', 'rad')} {steps} {turn('rad', 'deg')}")
    np.testing.assert_allclose(found, proj.transform(LONGITUDE, LATITUDE, np.zeros(3))[2], atol=1e-4)


@pytest.mark.parametrize("west", [0.0, -180.0])
def test_grids_of_the_world_begin_where_they_like(tmp_path, west):
    needs("rasterio")
    path = write_gtx(tmp_path / "world.gtx", -90, west, 181, 360, 1.0, lambda a, b: a + 0 * b)
    found = geoid_of(str(path))(np.array([-33.25, 12.5]), np.array([151.2, -179.75]))
    np.testing.assert_allclose(found, [-33.25, 12.5], atol=1e-4)


def test_a_grid_in_metres_of_a_map(tmp_path):
    """As geodetic surveys of some countries give theirs: in their own projection."""
    rasterio = needs("rasterio")
    east, north = 400_500 + 1000.0 * np.arange(120), 5_880_500 - 1000.0 * np.arange(100)
    values = 30 + 1e-5 * (east[None] - 450_000) + 2e-5 * (north[:, None] - 5_830_000)
    place = {"crs": "EPSG:25832", "transform": rasterio.Affine(1000, 0, 400_000, 0, -1000, 5_881_000)}
    size = {"height": 100, "width": 120, "count": 1, "dtype": "float64"}
    with rasterio.open(tmp_path / "geoid.tif", "w", driver="GTiff", **size, **place) as file:
        file.write(values, 1)
    lon, lat = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(451_234.0, 5_829_111.0)
    found = geoid_of(str(tmp_path / "geoid.tif"))(np.array([lat]), np.array([lon]))
    np.testing.assert_allclose(found, 30 + 1e-5 * 1_234 + 2e-5 * -889, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1000", "107 m below .*86 m above"),
        ("nan", "107 m below .*86 m above"),
        ("no.gtx", "no such file, and no number"),
        ("text.gtx", "no raster that GDAL reads"),
        ("far.gtx", "it does not reach the scene"),
        ("empty.gtx", "it has no heights of a geoid at the scene"),
        ("metres.gtx", "it has no heights of a geoid at the scene"),
    ],
)
def test_what_is_no_geoid_is_refused_in_one_line(tmp_path, monkeypatch, text, said):
    needs("rasterio")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.gtx").write_text("40 m")
    write_gtx(tmp_path / "far.gtx", -20)
    write_gtx(tmp_path / "empty.gtx", values=lambda a, b: -88.8888 + 0 * a * b)
    write_gtx(tmp_path / "metres.gtx", values=lambda a, b: 300 + 0 * a * b)
    with pytest.raises(BadInput, match=said) as caught:
        geoid_of(text)(LATITUDE, LONGITUDE)
    assert "--geoid " + text in str(caught.value) and "\n" not in str(caught.value)
