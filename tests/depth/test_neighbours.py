"""Which photographs stereo compares, of cameras that look down on scattered points."""

from types import SimpleNamespace

import numpy as np
import torch

from surfkit.depth import neighbours as module
from surfkit.depth.neighbours import neighbours
from surfkit.scene.observations import Observations, Observations2D
from surfkit.scene.parallax import degrees_between, worth

HEIGHT = 10.0


def compared(places, xyz, count=4, angle=12.0):
    """The choice for views from places at one height, (V, 2), that all show all points."""
    centres = np.column_stack([places, np.full(len(places), HEIGHT)])
    views = [
        SimpleNamespace(name=str(at), camera=SimpleNamespace(centre=torch.tensor(one)))
        for at, one in enumerate(centres)
    ]
    seen = Observations2D(np.arange(len(xyz)), np.full((len(xyz), 2), 0.5))
    tracks = Observations(xyz, np.ones(len(xyz)), {view.name: seen for view in views})
    return neighbours(views, tracks, count, angle)


def points(count=200):
    return np.random.default_rng(0).uniform((-3, -3, 0), (3, 3, 1), (count, 3))


def test_photographs_from_one_place_are_not_compared():
    """They match at any depth. Exposure brackets, and turning where the camera stands, give such photographs."""
    apart = HEIGHT * np.tan(np.radians(12))
    alone = compared(np.array([[0, 0], [apart, 0], [0, apart]]), points())
    assert sorted(alone[0]) == [1, 2]
    still = HEIGHT * np.tan(np.radians(0.4))  # of a drone that hovers
    thrice = np.array([[0, 0], [apart, 0], [0, apart], [0, 0], [still, 0]])
    found = compared(thrice, points())
    assert [sorted(found[at]) for at in (0, 3, 4)] == [[1, 2]] * 3
    assert sorted(found[1]) == [0, 2, 3, 4]
    assert compared(np.zeros((3, 2)), points()) == [[], [], []]


def test_many_photographs_from_one_place_do_not_take_the_place_of_others():
    apart = HEIGHT * np.tan(np.radians(12))
    assert compared(np.array([[0, 0]] * 60 + [[apart, 0]]), points())[0] == [60]


def test_angles_are_not_computed_where_places_tell_that_they_are_small(monkeypatch):
    """Of a thousand photographs from one place, that would be a million pairs."""
    apart, looked, real = HEIGHT * np.tan(np.radians(12)), [], module._worth
    monkeypatch.setattr(module, "_worth", lambda *words: looked.append(1) or real(*words))
    found = compared(np.array([[0, 0]] * 60 + [[apart, 0]]), points())
    assert found[:60] == [[60]] * 60 and len(looked) == 60 + module.MAX_CANDIDATE_VIEWS


def test_points_that_lie_nowhere_change_nothing():
    places, xyz = np.random.default_rng(1).uniform(-4, 4, (9, 2)), points()
    broken = np.concatenate([xyz, [[np.nan, 0, 0], [np.inf, 1, 1]]])
    assert compared(places, broken) == compared(places, xyz)


def test_angles_are_worth_most_where_they_are_preferred():
    between = degrees_between(np.array([[0, 0, 0.0]]), np.array([0, 0, 5.0]), np.array([5.0, 0, 5]))
    assert np.allclose(between, 45)
    found = worth(np.array([0.9, 1.1, 6, 12, 30]), 12.0)
    assert found[0] == 0 and 0 < found[1] < found[2] < found[3] == 1 and np.isclose(found[4], np.exp(-0.5))
