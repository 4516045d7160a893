"""Places on Earth, against PROJ."""

import numpy as np
import pytest
from needs import needs

from surfkit.core.check import BadInput
from surfkit.scene.earth import Site, from_utm, to_ecef, utm

LOCAL = "+proj=topocentric +ellps=WGS84 +lat_0=47.5 +lon_0=8.9 +h_0=430.0"
PROJ_ECEF = [  # pyproj 3.7, to EPSG:4978
    ("EPSG:32634", (500123.0, 5783283.0, 120.0), (3657232.942540, 1404012.000418, 5016568.267984)),
    ("EPSG:32756", (333568.94, 6247473.34, 30.0), (-4643967.848867, 2553042.930639, -3537262.077625)),
]


@pytest.mark.parametrize(("crs", "place", "wanted"), PROJ_ECEF)
def test_utm_lies_on_earth_where_proj_has_it(crs, place, wanted):
    np.testing.assert_allclose(to_ecef(crs, np.array([place]))[0], wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("crs", ["EPSG:32634", "EPSG:32756", "EPSG:32601"])
def test_any_place_in_a_zone_is_that_of_proj(crs):
    pyproj = needs("pyproj")
    draw = np.random.default_rng(0)
    places = draw.uniform([2e5, 1e5, -100], [8e5, 9e6, 5000], (200, 3))
    known = pyproj.Transformer.from_crs(pyproj.CRS(crs).to_3d(), "EPSG:4978", always_xy=True)
    np.testing.assert_allclose(to_ecef(crs, places), np.stack(known.transform(*places.T), 1), rtol=0, atol=1e-5)


def test_utm_and_back_again():
    for latitude, longitude in ((0.0, 9.0), (52.2, 21.3), (-33.9, 151.2), (83.0, 6.1)):
        zone = int((longitude + 180) // 6) + 1
        east, north = utm(latitude, longitude, zone, latitude < 0)
        back = from_utm(np.array([east]), np.array([north]), zone, latitude < 0)
        np.testing.assert_allclose(np.ravel(back), (latitude, longitude), rtol=0, atol=1e-10)  # 0.01 mm


def test_a_topocentric_site_is_its_own_frame():
    xyz = np.array([[0, 0, 0], [200.0, -50, 7]])
    site = Site.at(LOCAL, np.zeros(3))
    np.testing.assert_allclose(site.local(xyz), xyz, rtol=0, atol=1e-6)
    assert site.unit == pytest.approx(1, abs=1e-9)
    phi, lam = np.radians([47.5, 8.9])
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    np.testing.assert_allclose(site.pose[:3, 2], up, rtol=0, atol=1e-9)
    np.testing.assert_allclose(site.pose[:3, :3].T @ site.pose[:3, :3], np.eye(3), atol=1e-12)


def test_a_site_in_utm_has_metres_of_the_ground_and_the_axes_of_the_grid():
    origin = np.array([640000.0, 5783000.0, 100.0])  # 140 km from the meridian: the grid turns by 1.6 degrees
    site = Site.at("EPSG:32634", origin)
    east, north, up = site.local(origin + 100 * np.eye(3))
    np.testing.assert_allclose(east, [100 / 0.99984, 0, 0.0008], atol=2e-3)
    np.testing.assert_allclose(north, [0, 100 / 0.99984, 0.0008], atol=2e-3)
    np.testing.assert_allclose(up, [0, 0, 100], atol=1e-6)
    far = site.local((origin + [5000.0, 0, 0])[None])[0]
    assert far[2] == pytest.approx(-(5000**2) / (2 * 6.38e6), rel=0.02), "the Earth is round"


@pytest.mark.parametrize(
    ("crs", "text"),
    [
        ("EPSG:2263", "its axes are not east, north and up in one unit"),  # feet on the map, metres of height
        ("EPSG:4326", "it is in degrees, where lengths belong"),
        ("EPSG:1", "pyproj cannot place it on Earth"),
    ],
)
def test_what_has_no_place_is_refused_in_one_line(crs, text):
    needs("pyproj")
    with pytest.raises(BadInput, match=text) as caught:
        Site.at(crs, np.array([8.9, 47.5, 430.0]))
    assert "\n" not in str(caught.value)


def test_other_systems_are_placed_by_pyproj():
    needs("pyproj")
    assert Site.at("EPSG:25832", np.array([5e5, 5.3e6, 0])).unit == pytest.approx(1.0003, abs=1e-4)


def test_without_pyproj_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    with pytest.raises(BadInput, match=r"EPSG:25832.*pip install 'surfkit\[crs\]'"):
        to_ecef("EPSG:25832", np.array([[5e5, 5.3e6, 0]]))
