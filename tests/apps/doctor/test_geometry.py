"""Where a photograph shows points, and how it was exposed, against formulas and made-up gains."""

from pathlib import Path

import numpy as np
import pytest

from surfkit.apps.doctor.coverage_gaps import holes
from surfkit.apps.doctor.geometry import places
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
