"""Which photographs are compared."""

import itertools

import numpy as np
import pytest

from surfkit.apps.sfm import pair_selection
from surfkit.apps.sfm.exif import Exif
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.pair_selection import (
    MAX_EXHAUSTIVE_PHOTOS,
    alike,
    choose_pairs,
    distance_seen,
    facing,
    in_order,
    near,
    sequence,
    vlad,
)
from surfkit.apps.sfm.settings import Settings


def photos(count, position=lambda at: None, taken=lambda at: None):
    return [Photo(f"{at:03d}.jpg", (0, 0), exif=Exif(position=position(at), taken=taken(at))) for at in range(count)]


def scenes(count, groups):
    """Descriptors of photographs, of `groups` scenes in turn: features of a scene are alike."""
    rng = np.random.default_rng(0)
    centres = rng.integers(0, 200, (groups, 30, 128))

    def of(at):
        noise = np.random.default_rng(at).integers(0, 20, (30, 128))
        return (centres[at % groups] + noise).astype(np.uint8)

    return of


def test_a_small_set_is_compared_completely():
    pairs = choose_pairs(photos(7), Settings(), lambda at: 1 / 0)
    assert sorted(pairs) == list(itertools.combinations(range(7), 2))


def test_neighbours_by_gps_and_a_wrong_position_by_its_neighbours_in_time():
    grid = {at: (52 + 2e-4 * (at // 10), 16 + 3e-4 * (at % 10), 100.0) for at in range(100)}
    grid[45] = (53.0, 16.0, 100.0)
    given = photos(100, grid.get)
    pairs = choose_pairs(given, Settings(neighbours=8), lambda at: 1 / 0)
    assert len(pairs) < 100 * 11 and all(one < two for one, two in pairs) and len(set(pairs)) == len(pairs)
    assert {(33, at) for at in (34, 42, 43, 44)} <= set(pairs)
    assert {(44, 45), (45, 46), (42, 45)} <= set(pairs)


def test_neighbours_are_the_nearest():
    rng = np.random.default_rng(1)
    at = {number: (*(rng.uniform(0, 1e-3, 2) + (10, 20)), 5.0) for number in range(12)}
    found = near(photos(12, lambda number: None if number == 3 else at[number]), 2)
    flat = {n: np.array(p[:2]) * (111e3, 111e3 * np.cos(np.radians(10))) for n, p in at.items() if n != 3}
    wanted = set()
    for one in flat:
        nearest = sorted((n for n in flat if n != one), key=lambda n: np.linalg.norm(flat[n] - flat[one]))[:2]
        wanted |= {(min(one, n), max(one, n)) for n in nearest}
    assert found == wanted


@pytest.mark.parametrize("lacking", [2, 1])
def test_positions_without_an_altitude_have_neighbours_too(lacking):
    given = photos(20, position=lambda at: (52 + 1e-4 * at, 16.0, None if at % lacking == 0 else 1600.0))
    assert {(at, at + 1) for at in range(19)} <= near(given, 2)


def test_likeness_finds_the_same_scene():
    found = alike(24, 3, scenes(24, 4), 0, range(24))
    assert len(found) >= 24 * 3 / 2 and all((one - two) % 4 == 0 for one, two in found)
    assert found == alike(24, 3, scenes(24, 4), 0, range(24))


def test_likeness_is_that_of_each_photograph_with_all_others_however_many_are_compared_at_once(monkeypatch):
    descriptors = scenes(50, 7)
    words = np.random.default_rng(1).integers(0, 200, (16, 128)).astype(np.float32)
    monkeypatch.setattr(pair_selection, "kmeans2", lambda *given, **settings: (words, None))
    vectors = [vlad(descriptors(at).astype(np.float32), words).astype(np.float64) for at in range(50)]
    wanted = set()
    for at in range(0, 50, 3):
        others = sorted((-float(vectors[at] @ vectors[other]), other) for other in range(50) if other != at)
        wanted |= {(min(at, other), max(at, other)) for _, other in others[:4]}
    for batch in (1, 5, 256):
        monkeypatch.setattr(pair_selection, "LIKENESS_BATCH", batch)
        assert alike(50, 4, descriptors, 0, range(0, 50, 3)) == wanted


def test_looking_for_photographs_alike_tells_how_far_it_is(monkeypatch):
    monkeypatch.setattr(pair_selection, "LIKENESS_BATCH", 8)
    told = []
    monkeypatch.setattr(pair_selection, "emit", lambda event: told.append((event.what, event.done, event.total)))
    alike(24, 3, scenes(24, 4), 0, range(20))
    assert told[:24] == [("summing up photographs", at, 24) for at in range(1, 25)]
    assert told[24:] == [("looking for photographs alike", done, 20) for done in (8, 16, 20)]


def test_only_photographs_without_a_position_are_compared_by_likeness_besides_gps():
    grid = {at: (52 + 2e-4 * (at // 10), 16 + 3e-4 * (at % 10), 100.0) for at in range(100)}
    by_gps = set(choose_pairs(photos(100, grid.get), Settings(neighbours=8), lambda at: 1 / 0))
    del grid[45]
    found = set(choose_pairs(photos(100, grid.get), Settings(neighbours=8), scenes(100, 5)))
    assert {pair for pair in found - by_gps if 45 in pair} and sum(45 in pair for pair in found) >= 8
    assert len([pair for pair in found - by_gps if 45 not in pair]) < 10, "what takes the place of 45 among the nearest"


def test_a_large_set_without_gps_is_compared_by_likeness_and_sequence():
    count = MAX_EXHAUSTIVE_PHOTOS + 4
    pairs = choose_pairs(photos(count), Settings(neighbours=4), scenes(count, 8))
    assert {(0, 1), (0, 2), (0, 3)} <= set(pairs) and len(pairs) < count * 8
    assert sum((two - one) % 8 == 0 for one, two in pairs) > count


def test_order_is_by_time_where_all_say_it_else_by_name():
    late_first = photos(3, taken=lambda at: f"2024:01:01 00:00:{9 - at:02d}")
    assert in_order(late_first) == [2, 1, 0]
    assert in_order([*late_first, *photos(1)]) == [0, 3, 1, 2] or in_order([*late_first, *photos(1)])[0] in (0, 3)
    assert sequence([2, 1, 0], 1) == {(1, 2), (0, 1)}


def test_vlad_is_of_unit_length_and_knows_its_cluster():
    words = np.array([[0.0, 0], [10, 10]])
    found = vlad(np.array([[1.0, 0], [2, 0], [10, 12]]), words)
    np.testing.assert_allclose(found, np.array([1, 0, 0, 1]) / np.sqrt(2), atol=1e-6)
    assert not vlad(np.zeros((0, 2)), words).any()


def test_numbers_in_names_without_zeros_count_as_numbers():
    names = ["Right/run1_2.png", "Left/run1_10.png", "Left/run1_9.png", "Left/run1_1.png", "Left/run1.png"]
    order = in_order([Photo(name, (0, 0)) for name in names])
    assert [names[at] for at in order] == [names[at] for at in (4, 3, 2, 1, 0)]


@pytest.mark.parametrize("way", ["exhaustive", "gps", "sequence", "retrieval"])
def test_few_photographs_in_every_way(way):
    for count in (0, 1, 2, 3):
        pairs = choose_pairs(photos(count), Settings(pairs=way), scenes(count, 1))
        assert set(pairs) == set(itertools.combinations(range(count), 2))


def looking(centres, targets):
    """(N, 4, 4) world_to_camera of cameras that stand at places and look at others, x level."""
    forward = targets - centres
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, (0.0, 0.0, 1.0)) + 1e-9 * np.array([1.0, 0, 0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    found = np.tile(np.eye(4), (len(centres), 1, 1))
    found[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    found[:, :3, 3] = -(found[:, :3, :3] @ centres[..., None])[..., 0]
    return found


def grid(side, spacing, height):
    x, y = np.meshgrid(np.arange(side) * spacing, np.arange(side) * spacing)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], 1)


def test_around_an_object_the_next_ones_on_the_circle():
    angle = np.arange(200) * np.pi / 100
    centres = np.stack([50 * np.cos(angle), 50 * np.sin(angle), np.full(200, 30.0)], 1)
    poses = looking(centres, np.zeros((200, 3)))
    assert distance_seen(centres, poses[:, 2, :3]) == pytest.approx(np.hypot(50, 30))
    apart = [min(two - one, 200 - two + one) for one, two in facing(poses, 20)]
    assert min(apart) == 1 and max(apart) <= 20 and 200 * 10 <= len(apart) <= 200 * 20
    assert all(apart.count(step) == 200 for step in range(1, 6)), "the nearest half"
    assert sum(step > 10 for step in apart) > 200, "and some with more parallax"


def test_cameras_that_look_down_go_by_their_positions():
    centres = grid(20, 10.0, 80.0)
    poses = looking(centres, centres - (0, 0, 80.0))
    pairs = facing(poses, 8)
    far = [np.linalg.norm(centres[one] - centres[two]) for one, two in pairs]
    assert max(far) <= 40 and {(0, 1), (0, 20), (210, 211), (210, 230)} <= pairs


def test_cameras_back_to_back_are_not_compared():
    centres = np.repeat(grid(6, 1.0, 0.0)[:, [0, 2, 1]], 2, axis=0)
    side = np.tile([10.0, -10.0], 36)
    pairs = facing(looking(centres, centres + np.stack([0 * side, side, 0 * side], 1)), 12)
    assert all(one % 2 == two % 2 for one, two in pairs) and len(pairs) > 72 * 6


def test_five_cameras_of_a_drone_find_those_that_show_the_same_ground():
    stations, height = grid(12, 15.0, 60.0), 60.0
    tilts = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * height
    centres = np.repeat(stations, 5, axis=0)
    ahead = np.concatenate([np.tile(tilts, (len(stations), 1)), np.full((len(centres), 1), -height)], 1)
    pairs = np.array(sorted(facing(looking(centres, centres + ahead), 20)))
    apart = np.linalg.norm((centres + ahead)[pairs[:, 0]] - (centres + ahead)[pairs[:, 1]], axis=1)
    assert np.mean(apart < height) > 0.95, "footprints of 60 m overlap"
    plain = near(photos(len(centres), lambda at: (*(centres[at, :2] / 111e3), 60.0)), 20)
    share = np.mean([np.linalg.norm((centres + ahead)[one] - (centres + ahead)[two]) < height for one, two in plain])
    assert share < 0.8, "neighbours by position alone look elsewhere"


def test_poses_are_what_auto_goes_by_and_thousands_take_seconds():
    centres = grid(130, 10.0, 80.0)
    poses = looking(centres, centres - (0, 0, 80.0))
    pairs = choose_pairs(photos(len(centres)), Settings(neighbours=6), lambda at: 1 / 0, poses)
    assert 3 * len(centres) < len(pairs) < 6 * len(centres) and pairs == sorted(set(pairs))
    assert choose_pairs(photos(5), Settings(pairs="exhaustive"), lambda at: 1 / 0, poses[:5])[-1] == (3, 4)
    assert facing(poses[:1], 6) == set() and facing(poses[:2], 6) == {(0, 1)}
