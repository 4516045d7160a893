"""Coordinate reference systems by the names that lists give them, against pyproj."""

import numpy as np
import pyproj
import pytest

from surfkit.core.check import BadInput
from surfkit.io.datasets.crs_names import covers, names_a_system, system_of


@pytest.mark.parametrize(
    "text, crs",
    [
        ("WGS84 UTM 38s", "EPSG:32738"),
        ("WGS84 UTM 38S", "EPSG:32738"),
        ("wgs84 utm 7n ", "EPSG:32607"),
        ("WGS84 UTM 33 N", "EPSG:32633"),
        ("WGS 84 / UTM zone 33N", "EPSG:32633"),
        ("epsg:32633", "EPSG:32633"),
        ("WGS 84 / UTM zone 33N (EPSG::32633)", "EPSG:32633"),
        ("'+proj=utm +zone=33 +south=True +datum=WGS84 +units=m +no_defs=True'", "EPSG:32733"),
        ("+proj=longlat +datum=WGS84 +no_defs", "EPSG:4326"),
        ("WGS84", "EPSG:4326"),
        ("epsg::4326", "EPSG:4326"),
    ],
)
def test_spellings(text, crs):
    found = system_of(text)
    assert found.crs == crs and found.degrees == (crs == "EPSG:4326") and names_a_system(text)


@pytest.mark.parametrize(
    "text, said",
    [
        ("WGS84 UTM 38U", "letter 'U' .*N or S"),
        ("WGS84 UTM 38", "has no letter after the zone of UTM"),
        ("WGS84 UTM 61N", "zone 61 of UTM; they are 1 to 60"),
        ("EPSG:4978", "neither in degrees nor a map"),
        ("EPSG:999999", "no coordinate reference system that pyproj knows"),
    ],
)
def test_what_is_none(text, said):
    with pytest.raises(BadInput, match=said):
        system_of(text)


@pytest.mark.parametrize("crs", ["EPSG:2180", "EPSG:4258", "EPSG:32633", "EPSG:2263+6360", "wkt"])
def test_positions_are_those_of_pyproj(crs):
    given = pyproj.CRS("EPSG:32756" if crs == "wkt" else crs)
    there = {"EPSG:2263+6360": (-74.0, 40.7), "wkt": (151.2, -33.9)}.get(crs, (16.87, 52.75))
    x, y = pyproj.Transformer.from_crs("EPSG:4326", given.to_2d(), always_xy=True).transform(*there)
    found = system_of(given.to_wkt("WKT1_GDAL") if crs == "wkt" else crs)
    assert found.crs == ("EPSG:32756" if crs == "wkt" else crs)
    ((latitude, longitude, height),) = found.positions(np.array([[x, y, 100.0]]))
    assert (longitude, latitude) == pytest.approx(there, abs=1e-9)
    assert height == pytest.approx(100 * 1200 / 3937 if "6360" in crs else 100, rel=1e-9), "US survey feet"


def test_a_datum_of_its_own_is_no_wgs84():
    found = system_of("+proj=utm +zone=33 +ellps=intl +towgs84=-87,-98,-121,0,0,0,0 +units=m")
    away = found.positions(np.array([[500_000.0, 5_800_000.0, 0.0]])) - system_of("EPSG:32633").positions(
        np.array([[500_000.0, 5_800_000.0, 0.0]])
    )
    assert 1e-3 < np.abs(away[0, :2]).max() < 3e-3, "100 to 200 m"


def test_what_a_system_is_meant_for():
    assert covers("EPSG:32756", -33.9, 151.2) and not covers("EPSG:32756", 33.9, 151.2)
    assert not covers("EPSG:32756", -33.9, -151.2) and covers("EPSG:32701", -17, 179.99)
    assert covers("EPSG:2180", 52, 16) and not covers("EPSG:2180", 52, -16)
    assert covers("EPSG:3832", 10, -170) and not covers("EPSG:3832", 10, 0), "an area across 180 degrees"
