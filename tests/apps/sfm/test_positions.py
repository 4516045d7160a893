"""Which position counts for a photograph: lists, EXIF, XMP; signs that are missing; altitudes that are doubtful."""

from dataclasses import replace
from pathlib import Path

import pytest

from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.positions import Positions, settle
from surfkit.apps.sfm.settings import Settings
from surfkit.core.check import BadInput
from surfkit.runs.run_notes import collect_notes

BOTH = ("latitude", "longitude")
HERE = (33.9, 151.2, 120.0)
SOUTH = (-33.9, 151.2, 120.0)


def photo(name="a.jpg", position=None, **kwargs):
    return Photo(name, (0, 0), exif=Exif(position=position, **kwargs))


@pytest.fixture
def settled(tmp_path):
    """Positions and what is said, of photographs in photos/, beside files that are given by name and text."""

    def run(*photos, settings=None, files=()):
        root = tmp_path / "photos"
        root.mkdir(exist_ok=True)
        for name, text in dict(files).items():
            (root / name).write_text(text)
        with collect_notes() as notes:
            found = settle(photos, root, settings or Settings())
        return found, [photo.exif.position for photo in found.photos], "\n".join(notes.texts)

    return run


def test_what_is_whole_stays_and_nothing_is_said(settled):
    found, at, said = settled(photo(position=SOUTH), photo("b.jpg"))
    assert at == [SOUTH, None] and said == "" and found.open == () and found.crs is None
    assert len(found.readings()) == 1


def test_signs_are_looked_for_once_and_not_for_each_photograph(monkeypatch):
    """Of 30,000 photographs with all of them, that took minutes."""
    looks = []
    monkeypatch.setattr(Positions, "open", property(lambda positions: looks.append(1) or BOTH))
    assert len(Positions([photo(f"{at}.jpg", SOUTH) for at in range(50)]).readings()) == 4 and len(looks) == 1


def test_xmp_gives_positions_signs_and_altitudes(settled):
    _, at, said = settled(
        photo("only.jpg", xmp_position=SOUTH),
        photo("signs.jpg", HERE, unsigned=BOTH, xmp_position=SOUTH),
        photo("height.jpg", (*SOUTH[:2], None), xmp_altitude=7.0),
        photo("side.jpg", (*SOUTH[:2], 12.5), no_reference=True, xmp_altitude=-12.4),
    )
    assert at == [SOUTH, SOUTH, (*SOUTH[:2], 7.0), (*SOUTH[:2], -12.4)]
    assert "XMP only, which is used: 'only.jpg'" in said
    assert "those in XMP: 'signs.jpg'" in said
    assert "GPSAltitudeRef" not in said


def test_exif_and_xmp_that_contradict_each_other(settled):
    _, at, said = settled(photo(position=HERE, xmp_position=SOUTH))
    assert at == [HERE] and "more than 100 m apart, and those in EXIF are used: 'a.jpg'" in said
    found, _, said = settled(photo(position=HERE, unsigned=("latitude",), xmp_position=(-40.0, 151.2, 1.0)))
    assert found.open == ("latitude",) and "apart" in said, "another place tells no sign"


def test_photographs_near_by_tell_the_sign(settled):
    found, at, said = settled(photo(position=SOUTH), photo("b.jpg", HERE, unsigned=BOTH), photo("c.jpg"))
    assert at == [SOUTH, SOUTH, None] and found.open == ()
    assert "EXIF of 1 photographs has no letter" in said and "near by that have: 'b.jpg'" in said
    found, at, _ = settled(photo(position=(10.0, 10.0, 1.0)), photo("b.jpg", HERE, unsigned=("latitude",)))
    assert found.open == ("latitude",)
    assert [[p.exif.position for p in choice] for choice in found.readings()] == [
        [(10.0, 10.0, 1.0), HERE],
        [(10.0, 10.0, 1.0), SOUTH],
    ]


def test_each_choice_of_signs_is_a_reading(settled):
    found, _, _ = settled(photo(position=HERE, unsigned=BOTH))
    assert {choice[0].exif.position[:2] for choice in found.readings()} == {
        (a * 33.9, b * 151.2) for a in (1, -1) for b in (1, -1)
    }
    assert all(choice[0].exif.unsigned == () for choice in found.readings())


def test_altitudes(settled):
    none, zero = (*SOUTH[:2], None), (*SOUTH[:2], 0.0)
    _, at, said = settled(photo(position=none), photo("b.jpg", SOUTH))
    assert at == [none, SOUTH] and "1 of 2 positions have no altitude; the others place the scene" in said
    _, at, said = settled(photo(position=zero), photo("b.jpg", zero))
    assert at == [none, none] and "the altitudes of all 2 positions are 0, and count as missing" in said
    _, at, said = settled(photo(position=(*SOUTH[:2], -1600.0)))
    assert at == [(*SOUTH[:2], 1600.0)] and "below any land" in said
    _, at, said = settled(photo(position=(*SOUTH[:2], -140.0)))
    assert at == [(*SOUTH[:2], -140.0)] and "the positions are 140 m below their zero" in said
    _, at, said = settled(photo(position=SOUTH, no_reference=True))
    assert at == [SOUTH] and "(GPSAltitudeRef); it is taken as above: 'a.jpg'" in said
    _, at, said = settled(photo(position=none, above_start=40.0), photo("b.jpg", none, above_start=41.0))
    assert [height for *_, height in at] == [40.0, 41.0] and "above the place of the start" in said
    _, at, _ = settled(photo(position=SOUTH, above_start=40.0), photo("b.jpg", none, above_start=41.0))
    assert at == [SOUTH, none], "one zero for all"


GEO = "WGS84 UTM 56S\nA.JPG 333000 6247000 99 0 0 0 0.02 0.05\n"


def test_a_list_comes_first_then_geo_txt_then_exif(settled, tmp_path):
    far = (-33.904, 151.194, 5.0)
    photos = [photo("a.jpg", far, accuracy_m=(3, 3, 6), unsigned=()), photo("sub/b.jpg", SOUTH), photo("c.jpg")]
    found, at, said = settled(*photos, files={"geo.txt": GEO + "gone.jpg 333000 6247100 3\n"})
    assert at[0][2] == 99 and at[1:] == [SOUTH, None] and found.crs == "EPSG:32756"
    assert found.photos[0].exif.accuracy_m == (0.02, 0.02, 0.05)
    assert "geo.txt: 1 of its photographs" in said
    assert "1 photographs in EPSG:32756, instead of" in said
    assert ": 'sub/b.jpg', 'c.jpg'" in said and "km from" not in said
    path = tmp_path / "table.csv"
    path.write_text("label,longitude,latitude,altitude\nB,151.2,-33.9,7\n")
    found, at, said = settled(*photos, settings=Settings(positions=path))
    assert at == [far, (*SOUTH[:2], 7.0), None] and found.crs is None and "geo.txt" not in said
    assert "heights are above" not in said
    path.write_text("EPSG:4326+5773\nB,151.2,-33.9,7\n")
    for crs in ("auto", "EPSG:32756+5773"):
        _, at, said = settled(*photos, settings=Settings(positions=path, crs=crs))
        assert at[1] == (*SOUTH[:2], 7.0) and ("heights are above EGM96 height" in said) == (crs == "auto")


def test_a_position_that_a_list_has_disabled_is_not_that_of_exif_either(settled, tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("Label,Enable,Longitude,Latitude,Altitude\na,1,151.2,-33.9,7\nb,0,151.2,-33.9,8\n")
    photos = [photo("a.jpg", SOUTH), photo("b.jpg", SOUTH, xmp_position=SOUTH), photo("c.jpg", SOUTH)]
    _, at, said = settled(*photos, settings=Settings(positions=path))
    assert at == [(*SOUTH[:2], 7.0), None, SOUTH] and "gives the positions of 1 photographs" in said
    assert "not used: 'b'" in said and "1 are not in it" in said and "'c.jpg'" in said


def test_geo_txt_in_the_folder_above_and_one_of_other_photographs(settled, tmp_path):
    (tmp_path / "geo.txt").write_text(GEO)
    found, at, _ = settled(photo(position=HERE, unsigned=BOTH))
    assert at[0][0] == pytest.approx(-33.9, abs=0.01) and found.open == (), "a list has signs"
    (tmp_path / "geo.txt").write_text("EPSG:4326\nother.jpg 1 2 3\n")
    _, at, said = settled(photo(position=SOUTH))
    assert at == [SOUTH] and "geo.txt names none of the photographs and is not used" in said
    (tmp_path / "geo.txt").write_text("EPSG:4326\nmy notes on the geometry\n")
    with pytest.raises(BadInput, match="line 2 is .*; geo.txt"):
        settled(photo(position=SOUTH))


def test_a_list_far_from_exif_is_told(settled):
    _, _, said = settled(photo(position=HERE), files={"geo.txt": GEO})
    assert "km from their positions" in said


@pytest.mark.parametrize(
    "text, said",
    [
        ("other.jpg,1,2,3", "none of the 2 .*'1/a.jpg'"),
        ("a.jpg,1,2,3", "'a.jpg' .*'1/a.jpg', '2/a.jpg';"),
        ("1/a.jpg,1,2,3\n1/A.jpg,1,2,4", "'1/a.jpg' and '1/A.jpg' both name|may be"),
    ],
)
def test_names_that_will_not_do(settled, tmp_path, text, said):
    path = tmp_path / "table.csv"
    path.write_text(text)
    with pytest.raises(BadInput, match=said):
        settled(photo("1/a.jpg"), photo("2/a.jpg"), settings=Settings(positions=path, positions_crs="EPSG:4326"))


def test_settings_that_exclude_each_other():
    for wrong in (
        {"positions_crs": "EPSG:4326"},
        {"positions": Path("a"), "gps": False},
    ):
        with pytest.raises(BadInput, match="--positions"):
            replace(Settings(), **wrong)
