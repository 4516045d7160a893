"""Cells with equally many cameras, counted by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.partition import CameraGrid
from surfkit.scene.scene import View
from surfkit.testing.inputs import above, coarse_model


def under(*places: tuple[float, float]):
    """The city under cameras at these places."""
    return replace(
        coarse_model(200), views=[View(f"{i}.png", above(x, y), path=None) for i, (x, y) in enumerate(places)]
    )


def test_every_cell_has_as_many_cameras_as_the_next():
    """Random cameras, denser on one side: 3 columns of 67, 67 and 66, and 4 rows in each."""
    draws = np.random.default_rng(0)
    places = draws.uniform(0, 1, (200, 2)) ** 2
    cells = CameraGrid((3, 4)).cells(under(*places.tolist()))
    assert cells.count == 12
    counts = np.zeros(12, int)
    for block, (x0, y0, x1, y1) in enumerate(cells.boxes):
        low, high = np.array([x0, y0], float), np.array([x1, y1], float)  # None becomes not a number
        counts[block] = ((np.isnan(low) | (places >= low)) & (np.isnan(high) | (places < high))).all(1).sum()
    assert sorted(set(counts)) == [16, 17] and counts.sum() == 200
    columns = counts.reshape(3, 4).sum(1)
    assert columns.tolist() == [66, 67, 67]


def test_borders_lie_midway_and_columns_have_rows_of_their_own():
    places = [(0.0, 0.0), (0.2, 1.0), (1.0, 0.4), (1.4, 0.0)]
    boxes = CameraGrid((2, 2)).cells(under(*places)).boxes
    expected = [
        (None, None, 0.6, 0.5), (None, 0.5, 0.6, None), (0.6, None, None, 0.2), (0.6, 0.2, None, None)
    ]  # fmt: skip
    found = [[-9 if side is None else side for side in box] for box in boxes]
    assert np.allclose(found, [[-9 if side is None else side for side in box] for box in expected])


def test_cameras_in_lines_are_not_torn_apart():
    """6 x 5 cameras: each of three columns is two whole lines of flight; four are as even as lines can be."""
    sight = coarse_model()
    owner = CameraGrid((3, 5)).cells(sight).owner(sight.centres)
    assert torch.bincount(owner).tolist() == [2] * 15
    owner = CameraGrid((4, 1)).cells(sight).owner(sight.centres)
    assert sorted(torch.bincount(owner).tolist()) == [5, 5, 10, 10]
    assert torch.bincount(CameraGrid((6, 1)).cells(sight).owner(sight.centres)).tolist() == [5] * 6


def test_too_few_places_are_told():
    with pytest.raises(BadInput, match=r"camera-grid.blocks \(7, 1\)"):
        CameraGrid((7, 1)).cells(coarse_model())
    with pytest.raises(BadInput, match="too few places"):
        CameraGrid((2, 6)).cells(coarse_model())
