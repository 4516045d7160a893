"""Positions in files: geo.txt of OpenDroneMap, and tables as other programs write them."""

import numpy as np
import pyproj
import pytest

from surfkit.apps.sfm.georeference import chart_of, to_chart
from surfkit.apps.sfm.position_list import read_list
from surfkit.core.check import BadInput
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.earth import utm

PLACE = (-33.9, 151.2, 120.5)
EAST, NORTH = utm(*PLACE[:2], 56, True)


@pytest.fixture
def listed(tmp_path):
    def read(text, crs=None):
        path = tmp_path / "list.txt"
        path.write_text(text.format(e=f"{EAST:.6f}", n=f"{NORTH:.6f}"), encoding="utf-8-sig")
        return read_list(path, "list", crs)

    return read


METASHAPE = """# CoordinateSystem: WGS 84 / UTM zone 56S (EPSG::32756)
#Label,X/East,Y/North,Z/Altitude,Accuracy_X/Y_(m),Accuracy_Z_(m),Error_(m),X_error,Y_error,Z_error,X_est,Y_est,Z_est
a.jpg,{e},{n},120.5,0.02,0.04,9,1,1,1,7,7,7
b.jpg,,,,,,,,,,,,
"""


@pytest.mark.parametrize(
    "text, crs",
    [
        ("EPSG:4326\na.jpg 151.2 -33.9 120.5\n", None),
        ("WGS84 UTM 56S\na.jpg {e} {n} 120.5\n", None),
        ("WGS84 UTM 56s\r\n\r\n# a remark\r\na.jpg\t{e}\t{n}\t120.5\t0\t0\t0\r\n", None),
        ("'+proj=utm +zone=56 +south +datum=WGS84 +units=m +no_defs'\na.jpg {e} {n} 120.5 0 0 0 1 2 more words", None),
        ("EPSG:32756\n a.jpg   {e} {n} 120.5", None),
        ("a.jpg {e} {n} 120.5", "EPSG:32756"),
        ("a.jpg,{e},{n},120.5,EPSG:32756", None),
        ("a.jpg, 151.2, -33.9, 120.5, epsg:4326", None),
        ("name,x,y,z,crs\na.jpg,{e},{n},120.5,32756", None),
        ("Image;Latitude;Longitude;Altitude\na.jpg;-33,9;151,2;120,5", None),
        ("#image\tlongitude [deg]\tlatitude [deg]\theight (m)\na.jpg\t151.2\t-33.9\t120.5", None),
        ('SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n"a.jpg",-33.9,151.2,120.5', None),
        ("Northing,Easting,Elevation,Photo\n{n},{e},120.5,a.jpg", "WGS84 UTM 56S"),
        (METASHAPE, None),
    ],
)
def test_forms(listed, text, crs):
    found = listed(text, crs)
    assert list(found.positions) == ["a.jpg"]
    assert found.positions["a.jpg"] == pytest.approx(PLACE, abs=1e-8)
    degrees = "4326" in text or "ongitude" in text
    assert found.crs == (None if degrees else "EPSG:32756")


def test_well_known_text_is_left_to_pyproj(listed):
    found = listed(f"#CoordinateSystem: {pyproj.CRS('EPSG:2180').to_wkt('WKT1_GDAL')}\na.jpg,350000,520000,99\n")
    wanted = pyproj.Transformer.from_crs("EPSG:2180", "EPSG:4326", always_xy=True).transform(350000, 520000)
    assert found.positions["a.jpg"] == pytest.approx((wanted[1], wanted[0], 99), abs=1e-9) and found.crs == "EPSG:2180"


def test_heights_are_in_the_unit_that_the_list_or_its_system_states(listed):
    """Of a map in feet without heights of its own they are in feet, as those of control points on it are."""
    feet = 1200 / 3937
    x, y = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:2263", always_xy=True).transform(-73.6, 40.75)
    for crs, unit in (("EPSG:2263", feet), ("EPSG:2263+6360", feet), ("EPSG:2263+5703", 1.0)):
        with collect_notes() as notes:
            found = listed(f"{crs}\na.jpg {x} {y} 500\n")
        assert ("taken in its unit, US survey foot" in "".join(notes.texts)) == (crs == "EPSG:2263")
        assert found.positions["a.jpg"] == pytest.approx((40.75, -73.6, 500 * unit), abs=1e-6)
    assert to_chart(
        chart_of(np.array([found.positions["a.jpg"]]), "EPSG:2263"), np.array([[40.75, -73.6, 500 * feet]])
    )[0, 2] == pytest.approx(500, abs=1e-6)
    for unit, metres in (("ft", 0.3048), ("US ft", 0.3048), ("m", 1.0), ("deg", feet)):
        found = listed(f"name,x,y,z [{unit}]\na.jpg,{x},{y},500\n", "EPSG:2263")
        assert found.positions["a.jpg"][2] == pytest.approx(500 * metres, rel=1e-5), unit
        found = listed(f"Image,Latitude,Longitude,Altitude ({unit})\na.jpg,40.75,-73.6,500\n")
        assert found.positions["a.jpg"][2] == pytest.approx(500 * (1.0 if unit == "deg" else metres)), unit


def test_positions_that_are_switched_off_are_told_and_not_used(listed):
    """Metashape exports which positions are checked in its pane of references."""
    head = "#Label,Enable,X/Longitude,Y/Latitude,Z/Altitude\n"
    with collect_notes() as notes:
        found = listed(f"{head}a.jpg,1,151.2,-33.9,120.5\nb.jpg,0,3,4,5\nc.jpg,,151.2,-33.9,7\n")
    assert found.positions["b.jpg"] is None and found.positions["c.jpg"] == pytest.approx((-33.9, 151.2, 7))
    assert found.positions["a.jpg"] == pytest.approx(PLACE) and "1 photographs are disabled" in "".join(notes.texts)
    with pytest.raises(BadInput, match="line 2 has 'maybe' for whether it is enabled; write 1 or 0"):
        listed(f"{head}a.jpg,maybe,151.2,-33.9,120.5\n")
    with pytest.raises(BadInput, match="all of them disabled"):
        listed(f"{head}a.jpg,No,151.2,-33.9,120.5\n")


def test_heights_that_are_missing_blanks_in_names_and_accuracies(listed):
    rows = ["DJI 0001.JPG", "b.jpg", "c.jpg", "d"]
    rows = [
        f"{name} 151.2 -33.9{rest}"
        for name, rest in zip(rows, ("", " nan", " 7 0 0 0 0.5 1.5", " 7 0 0 0 0 0"), strict=True)
    ]
    found = listed("\n".join(["EPSG:4326", *rows]))
    assert {name: at[2] for name, at in found.positions.items()} == {
        "DJI 0001.JPG": None,
        "b.jpg": None,
        "c.jpg": 7,
        "d": 7,
    }
    assert found.accuracies == {"c.jpg": (0.5, 0.5, 1.5)}, "0 says nothing"
    assert listed(METASHAPE).accuracies == {"a.jpg": (0.02, 0.02, 0.04)}
    found = listed("name,lon,lat,alt,sd_e (m),sd_n (m),sd_u (m)\na,151.2,-33.9,1,0.1,0.2,0.3")
    assert found.accuracies == {"a": (0.1, 0.2, 0.3)}


def test_accuracies_are_in_the_unit_that_their_column_states_else_in_metres(listed):
    """Also where coordinates are in feet: Metashape and OpenDroneMap write accuracies in metres; it is said."""
    row = "a,980000,200000,300,1,2"
    with collect_notes() as notes:
        assert listed(f"name,x,y,z [ft],sxy,sz\n{row}", "EPSG:2263").accuracies == {"a": (1, 1, 2)}
    assert any("accuracies are taken in metres" in text for text in notes.texts)
    with collect_notes() as notes:
        found = listed(f"name,x,y,z [ft],sxy [ft],sz (m)\n{row}", "EPSG:2263")
        assert found.accuracies["a"] == pytest.approx((0.3048, 0.3048, 2))
        assert listed(METASHAPE).accuracies
    assert not notes.texts


@pytest.mark.parametrize("text", ["EPSG:4326\na.jpg 151.2 -33.9\nb.jpg 0 0", "WGS84 UTM 56S\na.jpg {e} {n}\nb.jpg 0 0"])
def test_places_of_a_receiver_without_a_fix_are_left_out(listed, text):
    with collect_notes() as notes:
        assert list(listed(text).positions) == ["a.jpg"]
    assert "1 positions are no place in EPSG" in notes.texts[0] and "'b.jpg'" in notes.texts[0]


def test_several_systems(listed):
    found = listed("name,x,y,z,crs\na,{e},{n},1,EPSG:32756\nb,151.2,-33.9,1,EPSG:4326")
    np.testing.assert_allclose(found.positions["a"], found.positions["b"], atol=1e-8)
    assert found.crs is None and found.named == "EPSG:32756 and EPSG:4326"


@pytest.mark.parametrize(
    "text, crs, said",
    [
        ("", None, "list: no positions; each line is name, x"),
        ("EPSG:4326\n", None, "no positions"),
        ("a.jpg,{e},{n},1", None, "names no .*--positions-crs"),
        ("EPSG:4326\na.jpg,1,2,3", "EPSG:4326", "'EPSG:4326'; leave --positions-crs out"),
        ("name,x,y,crs\na.jpg,1,2,EPSG:4326", "EPSG:4326", "names its system itself"),
        ("EPSG:4326\na.jpg {e} {n} 1", None, "'a.jpg' is not in degrees, as EPSG:4326 says"),
        ("WGS84 UTM 56S\na.jpg {n} {e} 1", None, "EPSG:32756 does not reach"),
        ("EPSG:4326\na.jpg 1 2 3\na.jpg 1 2 4", None, "lines 2 and 3 give two positions for 'a.jpg'"),
        ("EPSG:4326\na.jpg 1", None, "line 2 is 'a.jpg 1', not name, x"),
        ("EPSG:4326\na.jpg 1 nan 3", None, "line 2 is 'a.jpg 1 nan 3', not"),
        ("EPSG:4326\na.jpg,1,,3", None, "line 2 is"),
        ("foto,ost,nord\na.jpg,1,2", "EPSG:4326", "line 1 is 'foto ost nord', not name, x"),
        ("WGS84 UTM 56Q\na.jpg 1 2 3", None, "list: 'WGS84 UTM 56Q' has the letter 'Q'"),
        ("name,x,y,crs\na.jpg,1,2,WGS84 UTM 1\n", None, "list: line 2: 'WGS84 UTM 1' has no letter"),
        ("a.jpg 1 2 3", "WGS84 UTM 1", "--positions-crs: 'WGS84 UTM 1' has no letter"),
        ("no system\na.jpg 1 2 3", None, "'no system' is no coordinate reference system"),
    ],
)  # fmt: skip
def test_what_will_not_do(listed, text, crs, said):
    with pytest.raises(BadInput, match=said) as raised:
        listed(text, crs)
    assert "\n" not in str(raised.value)
