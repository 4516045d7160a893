"""Units, axes and lengths of coordinate reference systems, against PROJ."""

import math

import numpy as np
import pyproj
import pytest

from surfkit.core.check import BadInput
from surfkit.scene.crs import axes_of, code_in, exact, from_wkt, in_plan, metres_of, refuse_other_unit, scale_at
from surfkit.scene.lengths import unit_of
from surfkit.scene.scene import Frame

KM = "+proj=utm +zone=33 +datum=WGS84 +units=km"
US_FOOT = 1200 / 3937
TOPOCENTRIC = "+proj=topocentric +ellps=WGS84 +lat_0=47.5 +lon_0=8.9 +h_0=430.0"
NEW_YORK = np.array([980_000.0, 200_000.0, 50.0])


@pytest.mark.parametrize(
    ("crs", "metres", "symbol"),
    [
        ("EPSG:32633", 1, "m"),
        (TOPOCENTRIC, 1, "m"),
        ("EPSG:25832+7837", 1, "m"),
        ("EPSG:2180", 1, "m"),  # northing comes first in EPSG's order
        ("EPSG:31466", 1, "m"),
        ("EPSG:5514", 1, "m"),
        ("EPSG:3995", 1, "m"),  # both axes point south, away from the pole
        ("EPSG:2263", US_FOOT, "US ft"),
        ("EPSG:2263+6360", US_FOOT, "US ft"),
        ("EPSG:2222", 0.3048, "ft"),
        (KM, 1000, "km"),
    ],
)
def test_units(crs, metres, symbol):
    assert axes_of(crs).metres == pytest.approx(metres, rel=1e-12)
    assert unit_of(Frame(np.zeros(3), 1.0, metres, crs)) == symbol


@pytest.mark.parametrize(
    ("crs", "said"),
    [
        ("EPSG:5513", "its axes point south and west"),
        ("EPSG:2048", "its axes point west and south"),
        ("+proj=utm +zone=33 +axis=wnu", "its axes point west and north"),
        ("EPSG:2263+5703", "in units of US survey foot, heights in metre"),
        ("EPSG:32633+6360", "in units of metre, heights in US survey foot"),
        ("EPSG:4326", "in degrees"),
        ("EPSG:4326+5773", "in degrees"),
        ("EPSG:4978", "no easting and northing"),
        ('LOCAL_CS["x",UNIT["metre",1]]', "no easting and northing"),
        ("EPSG:1", "pyproj cannot place it on Earth"),
    ],
)
def test_what_is_no_map_of_one_unit_is_refused_in_one_line(crs, said):
    with pytest.raises(BadInput, match=said) as caught:
        axes_of(crs)
    assert crs in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("crs", "place", "scale"),
    [
        ("EPSG:3857", (1e6, 8_399_737.89), 0.5),  # web Mercator at 60 degrees: the cosine of the latitude
        ("EPSG:32633", (5e5, 5.8e6), 1.0),
        ("EPSG:25833", (5e5, 5.8e6), 1 / 0.9996),
        ("EPSG:2263", (980_000, 200_000), 1.0),
        (KM, (500, 5800), 1 / 0.9996),
        ("EPSG:27572", (6e5, 2.2e6), 1 / 0.99987742),  # grads from Paris
        ("+proj=tmerc +lat_0=0 +lon_0=9 +ellps=bessel +towgs84=598,74,418,0,0,0,0", (0, 5.8e6), 1.0),
    ],
)
def test_lengths_on_the_ground(crs, place, scale):
    assert scale_at(crs, np.array([*place, 10.0])) == pytest.approx(scale, rel=2e-3 if scale == 0.5 else 2e-4)


@pytest.mark.parametrize(
    ("crs", "metres", "agrees"),
    [
        ("EPSG:2263", None, True),
        ("EPSG:2263", 0.3048, True),
        ("EPSG:2263", 1.0, False),
        ("EPSG:32618", 0.3048, False),
        (KM, 1.0, False),
        ("EPSG:3857", 0.75, True),  # as long as it is at 41.4 degrees
        ("EPSG:3857", 0.5, False),
    ],
)
def test_a_unit_that_contradicts_the_system_is_refused(crs, metres, agrees):
    place = np.array([-8_238_000.0, 5_070_000.0, 0.0]) if crs == "EPSG:3857" else NEW_YORK
    if agrees:
        refuse_other_unit(crs, metres, place)
        return
    with pytest.raises(BadInput, match=r"a unit is .* m; .*metres_per_unit"):
        refuse_other_unit(crs, metres, place)


def test_no_transformation_is_a_guess():
    """PROJ leaves the shift of an unknown datum out, and says so in a description only."""
    unknown = "+proj=utm +zone=33 +ellps=bessel +type=crs"
    assert math.isfinite(pyproj.Transformer.from_crs(unknown, "EPSG:4326", always_xy=True).transform(5e5, 5.8e6)[0])
    assert exact(unknown, "EPSG:4326") is None and exact("EPSG:31467", "EPSG:4326") is not None


@pytest.mark.parametrize("number", [2056, 2263, 5514, 25833, 31467, 32633])
@pytest.mark.parametrize("version", ["WKT1_GDAL", "WKT1_ESRI", "WKT2_2019"])
def test_what_a_text_says_of_a_map(number, version):
    """The code is that in the text: ESRI writes none."""
    known = pyproj.CRS(f"EPSG:{number}")
    found = from_wkt("a.prj", known.to_wkt(version))
    assert code_in(found) == (None if version == "WKT1_ESRI" else f"EPSG:{number}")
    assert metres_of(found) == pytest.approx(known.axis_info[0].unit_conversion_factor, rel=1e-12)


def test_a_text_with_heights_or_a_shift_of_datum_has_the_code_of_its_map():
    heights = pyproj.CRS("EPSG:25833+7837")
    shifted = pyproj.CRS("EPSG:31467").to_wkt("WKT1_GDAL")
    shifted = shifted.replace(']],AUTHORITY["EPSG","6314"]', "]],TOWGS84[598,74,418,0,0,0,0]")
    assert "TOWGS84" in shifted and pyproj.CRS(shifted).is_bound and code_in(pyproj.CRS(shifted)) is None
    assert code_in(in_plan(from_wkt("a", shifted))) == "EPSG:31467"
    assert code_in(in_plan(from_wkt("a", heights.to_wkt("WKT1_GDAL")))) == "EPSG:25833"
    esri = in_plan(from_wkt("a", heights.to_wkt("WKT1_ESRI")))  # a map and heights, one after the other
    assert esri.is_projected and not esri.is_compound


def test_no_code_is_guessed_from_what_is_alike():
    alike = pyproj.CRS("+proj=utm +zone=33 +ellps=intl")
    assert alike.to_epsg() == 23033, "ED50, which is 100 m away"
    assert code_in(alike) is None


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("x", "Invalid WKT string: x;"),
        ("PROJCS[", "missing ];"),
        ('PROJCS["a",UNIT["metre",1],AUTHORITY["EPSG","32632"]]', "missing CONVERSION node;"),
        ("PROJCS[" * 1000, "too many nesting levels;"),
        ('PROJCS["\ud800"]', "'utf-8' codec can't encode character '\\ud800' in position 8: surrogates not allowed;"),
    ],
)
def test_a_text_that_is_none_is_refused_in_one_line(text, why):
    with pytest.raises(BadInput) as caught:
        from_wkt("a.prj", text)
    assert str(caught.value).startswith(
        f"a.prj: no coordinate reference system that pyproj reads: {why} export it again"
    )


def test_a_unit_that_is_no_length_is_not_known():
    feet = pyproj.CRS("EPSG:2222").to_wkt("WKT1_GDAL")
    assert metres_of(from_wkt("a", feet)) == 0.3048
    for wrong in ("0", "-1", "1e7"):
        assert metres_of(from_wkt("a", feet.replace('UNIT["foot",0.3048', f'UNIT["foot",{wrong}'))) is None
