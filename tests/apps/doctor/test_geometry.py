"""Where a photograph shows points, and how it was exposed, against formulas and made-up gains."""

from pathlib import Path

import numpy as np
import pytest

from surfkit.apps.doctor import geometry
from surfkit.apps.doctor.coverage_gaps import holes
from surfkit.apps.doctor.geometry import places, points_in_common, survey
from surfkit.io.datasets.raw_dataset import RawImage, load_pycolmap


def shot(model, *params):
    return RawImage(
        "a", np.eye(4), load_pycolmap().Camera(model=model, width=100, height=80, params=list(params)), Path("a")
    )


def test_places_are_shares_of_the_photograph_and_nothing_beyond_it():
    xyz = np.array([[0, 0, 2], [1.9, 0, 2], [-1.9, 1.5, 2], [2.1, 0, 2], [0, 1.7, 2], [0, 0, -2], [0, 0, 0], [9, 0, 2]])
    found, depth = places(shot("PINHOLE", 50, 50, 50, 40), xyz)
    assert found[:3] == pytest.approx(np.array([[0.5, 0.5], [0.975, 0.5], [0.025, 0.96875]]))
    assert np.isnan(found[3:]).all() and (depth == xyz[:, 2]).all()


def test_places_follow_the_lens_and_far_rays_do_not_fold_back():
    xyz = np.array([[1.0, 0, 2], [8.0, 0, 2]])
    found, _ = places(shot("SIMPLE_RADIAL", 50, 50, 40, -0.1), xyz)
    assert found[0] == pytest.approx([(50 * 0.5 * (1 - 0.1 * 0.25) + 50) / 100, 0.5])
    folded = (50 * 4 * (1 - 0.05 * 16) + 50) / 100
    assert 0 < folded < 1 and np.isnan(places(shot("SIMPLE_RADIAL", 50, 50, 40, -0.05), xyz)[0][1]).all()


def test_a_hole_is_told_where_it_is_also_far_from_the_origin():
    ground = np.stack(np.meshgrid(np.arange(0, 200, 2.0), np.arange(0, 200, 2.0), [0.0]), -1).reshape(-1, 3)
    ground = ground[np.abs(ground[:, :2] - (120, 80)).max(1) > 30]
    centres = np.stack(np.meshgrid(np.arange(0, 201, 20.0), np.arange(0, 201, 20.0), [50.0]), -1).reshape(-1, 3)
    for place, size in (((621_400, 5_848_200, 0), 1.0), ((0, 0, 0), 0.001)):
        (found,) = holes(ground * size + place, centres * size + place)
        spot = [float(value) for value in found.text.partition("(")[2].partition(")")[0].split(", ")]
        assert np.abs((np.array(spot) - place) / size - (120, 80, 0)).max() < 5, found.text


def strip(count):
    """Photographs in a row, each of 100 sparse points of its own, and of a few of its neighbours."""
    camera = load_pycolmap().Camera(model="PINHOLE", width=100, height=80, params=[50, 50, 50, 40])
    shots, draw = [], np.random.default_rng(0)
    for at in range(count):
        pose = np.eye(4)
        pose[:3, 3] = -4.0 * at, 0, 5.0
        shots.append(RawImage(f"{at:04d}", pose, camera, Path("a")))
    return shots, draw.uniform([-2, -3, -0.2], [4.0 * count - 2, 3, 0.2], (100 * count, 3))


def test_of_many_photographs_those_without_points_are_told_and_no_others():
    """A sample of the points has hardly any for each of them."""
    shots, xyz = strip(1_200)
    xyz = xyz[np.abs(xyz[:, 0] - 4 * 700) > 12]
    (bare,) = [one for one in survey(shots, shots, xyz, 0.0).findings if one.what == "cameras-without-points"]
    assert bare.names == ("0699", "0700", "0701") and len(xyz) > 25 * geometry.SAMPLED_POINTS


def test_points_in_common_are_those_of_the_photographs():
    shots, xyz = strip(1_200)
    near = points_in_common(shots[500:520], xyz)
    assert len(near) > 900 and (points_in_common(shots[500:502], xyz)[:, 0] < 4 * 505).all()
    assert len(points_in_common([shots[0], shots[900]], xyz)) == len(points_in_common([], xyz)) == 0
