"""Which of the readings of positions without signs the cameras allow, and what no survey can be."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.georeference import NoSimilarity, Placement
from surfkit.apps.sfm.gravity_alignment import up_of
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.map_choice import decide, heights_named, locate, readings
from surfkit.apps.sfm.positions import Positions
from surfkit.apps.sfm.survey_plausibility import Handedness, upside_down
from surfkit.core.check import BadInput
from surfkit.io.datasets.topocentric import Similarity
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.earth import from_utm

from .models import down, reconstruction
from .pictures import looking

TURN = Rotation.from_rotvec([0.7, -0.2, 1.1]).as_matrix()
CORNER = np.array([333_000.0, 6_247_000.0, 0.0])  # zone 56 south, Sydney
RNG = np.random.default_rng(0)
CENTRES = np.column_stack([RNG.uniform(-60, 60, (20, 2)), 140 + RNG.uniform(-0.3, 0.3, 20)])
GROUND = np.column_stack([RNG.uniform(-80, 80, (200, 2)), 100 + RNG.uniform(-2, 2, 200)])
POSES = {f"{at}.jpg": pose for at, pose in enumerate(down(CENTRES))}


def model(poses=POSES, points=GROUND):
    return reconstruction(poses, points, TURN, 0.02, (1, 2, 3))


def photographs(letters="SE", heights=True, east=1.0, centres=CENTRES):
    """Photographs of Sydney, with some letters of the hemisphere only; `east` -1 mirrors the map."""
    latitude, longitude = from_utm(centres[:, 0] + CORNER[0], centres[:, 1] + CORNER[1], 56, True)
    unsigned = tuple(a for a, letter in (("latitude", "S"), ("longitude", "E")) if letter not in letters)
    signs = np.array([1 if "latitude" in unsigned else -1, 1, 1])
    at = np.column_stack([-latitude, east * longitude, centres[:, 2]]) * signs
    return [
        Photo(name, (0, 0), exif=Exif(position=(*p[:2], p[2] if heights else None), unsigned=unsigned))
        for name, p in zip(POSES, at.tolist(), strict=True)
    ]


def decided(photos, crs="auto", given=None):
    given, positions = given or model(), Positions(photos)
    with collect_notes() as notes:
        choices = readings(positions, crs)
        chosen = decide(given, choices, positions, 0)
        found = locate(given, chosen, 0) if not isinstance(chosen, NoSimilarity) else chosen
    return found, notes.texts


@pytest.mark.parametrize("heights", [True, False])
@pytest.mark.parametrize("letters", ["S", "E"])
def test_one_missing_letter_is_decided_by_the_cameras(letters, heights):
    found, said = decided(photographs(letters, heights))
    assert found.chart.crs == "EPSG:32756"
    centres = found.similarity.points(np.stack([model().image(at).projection_center() for at in range(20)]))
    away = centres + found.chart.offset - CENTRES - CORNER
    assert np.linalg.norm(away[:, :2], axis=1).max() < 0.1
    assert len(said) == 1 and "EXIF of 20 photographs has no letter of the hemisphere" in said[0]
    assert "the only place that fits the cameras is 33.9" in said[0] and "S 151.19" in said[0]


def test_without_both_letters_half_a_turn_is_left_open_unless_a_system_decides():
    found, said = decided(photographs(""))
    assert isinstance(found, NoSimilarity) and said == []
    assert "N 151.19" in found.reason and "S 151.19" in found.reason and "fit alike" in found.reason
    assert "W" in found.reason.split("S 151.19")[0], "north-west, half a turn from south-east"
    found, said = decided(photographs(""), "EPSG:32756")
    assert isinstance(found, Placement) and "S 151.19" in said[0]
    found, _ = decided(photographs(""), "EPSG:28356")  # GDA94 / MGA zone 56
    assert isinstance(found, Placement) and found.chart.crs == "EPSG:28356"
    with pytest.raises(BadInput, match="--crs EPSG:2180 is not"):
        decided(photographs(""), "EPSG:2180")


def test_a_wrong_letter_is_refused():
    found, _ = decided(photographs(east=-1.0))
    assert isinstance(found, NoSimilarity)
    assert "fit mirrored only" in found.reason and "have a wrong sign" in found.reason


def test_cameras_that_fit_no_sign():
    wrong = photographs("S", centres=RNG.uniform(-60, 60, (20, 3)))
    found, _ = decided(wrong)
    assert isinstance(found, NoSimilarity) and "no sign fits (" in found.reason


def test_in_plan_heights_are_above_the_middle_of_the_ground():
    found, said = decided(photographs(heights=False))
    assert found.plan and said == []
    assert found.similarity.scale == pytest.approx(50, rel=1e-3)
    points = found.similarity.points(0.02 * GROUND @ TURN.T + (1, 2, 3))
    wanted = GROUND + CORNER - found.chart.offset - (0, 0, np.median(GROUND[:, 2]))
    assert np.linalg.norm(points - wanted, axis=1).max() < 0.2
    assert np.abs(found.fit.residuals).max() < 0.1


def test_few_altitudes_place_in_plan_and_enough_place_in_space():
    photos, bare = photographs(), photographs(heights=False)
    found, _ = decided([*photos[:3], *bare[3:]])
    assert found.plan and len(found.names) == 20
    found, _ = decided([*photos[:12], *bare[12:]])
    assert not found.plan and len(found.names) == 12
    points = found.similarity.points(0.02 * GROUND @ TURN.T + (1, 2, 3))
    assert np.linalg.norm(points + found.chart.offset - GROUND - CORNER, axis=1).max() < 0.1


def test_a_list_in_feet_is_placed_on_another_map():
    with collect_notes() as notes:
        (found,) = readings(Positions(photographs(), "EPSG:2263"), "auto")
    assert found.chart.crs == "EPSG:32756" and "listed in EPSG:2263, which a scene cannot be in" in notes.texts[0]
    (found,) = readings(Positions(photographs(), "EPSG:28356"), "auto")
    assert found.chart.crs == "EPSG:28356"
    assert readings(Positions([Photo("a.jpg", (0, 0))]), "auto") == []


def test_a_tower_seen_from_its_foot_is_no_mistake():
    angles = np.linspace(0, 6, 12)
    eyes = np.column_stack([30 * np.cos(angles), 30 * np.sin(angles), np.full(12, 2.0)])
    poses = {f"{at}.jpg": looking(eye, (0, 0, 22)) for at, eye in enumerate(eyes)}
    points = np.column_stack([RNG.uniform(-3, 3, (100, 2)), RNG.uniform(5, 40, 100)])
    given = reconstruction(poses, points, TURN, 0.02, (1, 2, 3))
    photos = {name: Photo(name, (0, 0)) for name in poses}
    upright = Similarity(TURN.T, 50.0, np.zeros(3))
    for handed in (True, False):
        why = upside_down(given, upright, up_of(given, photos), 1.0, handed)
        assert why is None, "it looks up 34 degrees, from below"
    over = Similarity(np.diag([1.0, -1.0, -1.0]) @ TURN.T, 50.0, np.zeros(3))
    for handed in (True, False):
        why = upside_down(given, over, up_of(given, photos), 1.0, handed)
        assert (why is None) == handed, "seen from above, by cameras that were held upside down"


def test_mirrored_places():
    xyz = RNG.uniform(-5, 5, (9, 3))
    hand = Handedness.of(xyz, 3 * xyz @ TURN.T, 0.1)
    assert hand.right and not hand.wrong
    hand = Handedness.of(xyz, 3 * (xyz * (1, 1, -1)) @ TURN.T + 7, 0.1)
    assert hand.wrong and not hand.right and hand.plain > 1 and hand.mirrored < 1e-9
    flat = xyz * (1, 1, 0)
    hand = Handedness.of(flat, flat * (1, -1, 1) + RNG.normal(0, 0.3, (9, 3)), 0.1)
    assert not hand.wrong and not hand.right, "of a plane nobody can tell"


def test_heights_that_count_down_are_found_out_where_they_vary():
    rough = CENTRES + np.column_stack([np.zeros((20, 2)), RNG.uniform(-9, 9, 20)])
    given = model({f"{at}.jpg": pose for at, pose in enumerate(down(rough))})
    found, _ = decided(photographs(centres=rough), given=given)
    assert isinstance(found, Placement) and found.handed
    found, _ = decided(photographs(centres=rough * (1, 1, -1)), given=given)
    assert isinstance(found, NoSimilarity) and "positions fit mirrored only, to 0.00 m for" in found.reason


@pytest.mark.parametrize(
    ("zeros", "given", "crs", "said"),
    [
        (
            ["sea level"],
            "auto",
            "EPSG:32756+5773",
            "(EGM96); where the drone counts them from the ellipsoid, give --crs",
        ),
        (
            ["sea level"],
            "EPSG:32756",
            "EPSG:32756",
            "--crs EPSG:32756 has no vertical part: heights are taken as they are",
        ),
        (["sea level"], "EPSG:32756+5773", "EPSG:32756+5773", None),
        (["ellipsoid"], "auto", "EPSG:32756", "heights are above the ellipsoid, as RTK"),
        (["ellipsoid"], "EPSG:32756+5773", "EPSG:32756+5773", "says something else; leave its vertical part out"),
        (["ellipsoid", "sea level"], "auto", "EPSG:32756", "up to 100 m apart"),
        ([None], "auto", "EPSG:32756", None),
        (["sea level", None], "auto", "EPSG:32756", "are those of a list and of others those in EXIF"),
        (["ellipsoid", None], "auto", "EPSG:32756", "are those of a list and of others those in EXIF"),
    ],
)
def test_the_system_says_what_heights_are_above_if_photographs_do(zeros, given, crs, said):
    photos = photographs()
    placed = decided(photos)[0]
    placed = replace(placed, chart=replace(placed.chart, crs="EPSG:32756" if given == "auto" else given))
    told = [replace(photo, exif=replace(photo.exif, zero=zeros[at % len(zeros)])) for at, photo in enumerate(photos)]
    found, line = heights_named(placed, told, given)
    assert found.chart.crs == crs and replace(found, chart=placed.chart) == placed
    assert (said in line if said else line == "") and "\n" not in line
