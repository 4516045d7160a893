"""Places on Earth, against PROJ."""

import numpy as np
import pyproj
import pytest
from grids import plane, write_gtx
from needs import needs

from surfkit.core.check import BadInput
from surfkit.scene.earth import LocalEarthFrame, from_utm, on_earth, to_ecef, utm
from surfkit.scene.geoid import geoid_of

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
    site = LocalEarthFrame.at(LOCAL, np.zeros(3))
    np.testing.assert_allclose(site.local(xyz), xyz, rtol=0, atol=1e-6)
    assert site.unit == pytest.approx(1, abs=1e-9)
    phi, lam = np.radians([47.5, 8.9])
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    np.testing.assert_allclose(site.pose[:3, 2], up, rtol=0, atol=1e-9)
    np.testing.assert_allclose(site.pose[:3, :3].T @ site.pose[:3, :3], np.eye(3), atol=1e-12)


def test_a_site_in_utm_has_metres_of_the_ground_and_the_axes_of_the_grid():
    origin = np.array([640000.0, 5783000.0, 100.0])  # 140 km from the meridian: the grid turns by 1.6 degrees
    site = LocalEarthFrame.at("EPSG:32634", origin)
    east, north, up = site.local(origin + 100 * np.eye(3))
    np.testing.assert_allclose(east, [100 / 0.99984, 0, 0.0008], atol=2e-3)
    np.testing.assert_allclose(north, [0, 100 / 0.99984, 0.0008], atol=2e-3)
    np.testing.assert_allclose(up, [0, 0, 100], atol=1e-6)
    far = site.local((origin + [5000.0, 0, 0])[None])[0]
    assert far[2] == pytest.approx(-(5000**2) / (2 * 6.38e6), rel=0.02), "the Earth is round"


@pytest.mark.parametrize(
    ("crs", "text"),
    [
        ("EPSG:2263+5703", "in units of US survey foot, heights in metre"),
        ("EPSG:3857", "1 m to the east or north is .* m on the map"),
        ("EPSG:5513", "its axes point south and west"),
        ("+proj=utm +zone=33 +ellps=bessel", "shift .*WGS 84 is not known"),
        ("EPSG:4326", "degrees, where lengths"),
        ("EPSG:1", "pyproj cannot place it on Earth"),
    ],
)
def test_what_has_no_place_is_refused_in_one_line(crs, text):
    with pytest.raises(BadInput, match=text) as caught:
        LocalEarthFrame.at(crs, np.array([1e6, 6e6, 430.0]))
    assert "\n" not in str(caught.value)


def test_other_systems_are_placed_by_pyproj():
    assert LocalEarthFrame.at("EPSG:25832", np.array([5e5, 5.3e6, 0])).unit == pytest.approx(1.0003, abs=1e-4)


PLACE = np.array([451_234.5, 5_873_456.25, 37.0])  # 8.273207 east, 53.008438 north
BERLIN = np.array([[4_590_000.0, 5_820_000.0, 50.0]])


def ellipsoidal(ecef):
    """Longitude, latitude and height above the ellipsoid, by PROJ."""
    return pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*np.ravel(ecef))


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:25832", "EPSG:25832+7837", "EPSG:32632+5773"])
def test_heights_above_a_geoid_that_is_given(tmp_path, crs):
    needs("rasterio")
    for geoid, height in ((str(write_gtx(tmp_path / "g.gtx")), plane(53.00843816, 8.27320668)), ("39.5", 39.5)):
        convert, notes = on_earth(crs, PLACE, geoid_of(geoid))
        found = ellipsoidal(convert(PLACE[None]))
        np.testing.assert_allclose(found[:2], (8.27320668, 53.00843816), atol=1e-7)
        assert found[2] == pytest.approx(37 + height, abs=1e-3) and notes == ()


def test_a_geoid_that_proj_has_is_used_without_a_word(tmp_path):
    """The system names a grid that is there; PROJ itself gives the height."""
    text = f"+proj=utm +zone=32 +datum=WGS84 +geoidgrids={write_gtx(tmp_path / 'g.gtx')} +type=crs"
    convert, notes = on_earth(text, PLACE)
    wanted = pyproj.Transformer.from_crs(text, "EPSG:4979", always_xy=True).transform(*PLACE)
    np.testing.assert_allclose(ellipsoidal(convert(PLACE[None])), wanted, atol=1e-6)
    assert wanted[2] == pytest.approx(37 + plane(53.00843816, 8.27320668), abs=1e-3) and notes == ()


@pytest.mark.parametrize(
    ("crs", "grid"),
    [
        ("+proj=utm +zone=32 +datum=WGS84 +geoidgrids=no_such_geoid.gtx", "no_such_geoid.gtx"),
        ("EPSG:25832+7837", "de_bkg_gcg2016.tif"),
        ("EPSG:32632+5773", "us_nga_egm96_15.tif"),
    ],
)
def test_a_geoid_that_is_not_installed_is_named(crs, grid):
    """PROJ leaves the height as it is, and says so in the description of its transformation only."""
    convert, notes = on_earth(crs, PLACE)
    height = ellipsoidal(convert(PLACE[None]))[2]
    if crs.startswith("EPSG") and not notes:  # a machine that has the grid
        assert height == pytest.approx(37 + 39.5, abs=2)
        return
    assert len(notes) == 1 and f"`pyproj sync --file {grid}`" in notes[0] and "--geoid FILE or METRES" in notes[0]
    assert height == pytest.approx(37, abs=1e-3)


def test_without_a_vertical_part_heights_are_above_the_ellipsoid_of_the_datum_and_a_note_says_so():
    for crs, metres, place in (("EPSG:25832", 1, PLACE), ("EPSG:2263", 1200 / 3937, [980_000.0, 200_000.0, 50.0])):
        convert, notes = on_earth(crs, np.array(place))
        known = pyproj.Transformer.from_crs(pyproj.CRS(crs).to_3d(), "EPSG:4979", always_xy=True)
        wanted = known.transform(*place[:2], place[2] * metres)
        np.testing.assert_allclose(ellipsoidal(convert(np.array([place]))), wanted, rtol=0, atol=1e-6)
        assert f"{crs} does not say what heights are above" in notes[0] and "--geoid" in notes[0]
    assert LocalEarthFrame.at("EPSG:2263", np.array(place)).unit == pytest.approx(1200 / 3937, rel=1e-4)


def test_a_datum_that_is_placed_roughly_only_is_told():
    """Without its grid, PROJ brings DHDN to WGS 84 within 2 m there; far from Germany by any shift that it knows."""
    notes = on_earth("EPSG:31468", BERLIN[0], geoid_of("40"))[1]
    if notes:  # else the grid is installed here
        assert "EPSG:31468 is placed on Earth within 2 m" in notes[0] and "de_adv_BETA2007.tif" in notes[0]
    (note,) = on_earth("EPSG:25832", np.array([5e5, 2e6, 0.0]), geoid_of("40"))[1]
    assert "EPSG:25832 is not meant for latitude 18." in note
