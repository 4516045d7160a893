"""Borders of blocks: on one side one block, on the other another, and none is missed."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from surfkit.partition.base import Cells, Contraction, Ground
from surfkit.partition.borders import border_places

FLAT = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
GRID = ((None, None, 0.0, 1.0), (0.0, None, None, 1.0), (None, 1.0, 0.0, None), (0.0, 1.0, None, None))
UNIT = tuple((x / 3 or None, y / 3 or None, None if x == 2 else (x + 1) / 3, None if y == 2 else (y + 1) / 3)
             for y in range(3) for x in range(3))  # fmt: skip


@pytest.mark.parametrize(
    "cells",
    [
        Cells(FLAT, GRID, (0, 1, 2, 3)),
        Cells(FLAT, GRID, (0, 1, 0, 2)),  # the first and the third are one block
        Cells(FLAT, UNIT, tuple(range(9)), Contraction((-1.0, -2.0), (2.0, 1.0))),
        Cells(FLAT, UNIT, (0, 0, 1, 0, 2, 1, 3, 3, 3), Contraction((-1.0, -2.0), (2.0, 1.0))),
    ],
)
def test_places_are_where_the_owner_changes(cells):
    low, high, step = np.array([-6.0, -5]), np.array([7.0, 6]), 0.01
    places = border_places(cells, low, high, step)
    assert (places >= low).all() and (places <= high).all()

    def owner(flat):
        return cells.owner(torch.from_numpy(np.column_stack([flat, np.zeros(len(flat))]))).numpy()

    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    around = np.stack([owner(places + 0.02 * np.array([np.cos(t), np.sin(t)])) for t in turns])
    assert (around.min(0) != around.max(0)).all()
    # and from everywhere: pairs of close points with two owners have a border between them
    draw = np.random.default_rng(0)
    some = draw.uniform(low + 0.1, high - 0.1, (40_000, 2))
    angle = draw.uniform(0, 2 * np.pi, len(some))
    others = some + 0.05 * np.column_stack([np.cos(angle), np.sin(angle)])
    apart = owner(some) != owner(others)
    assert apart.sum() > 50 and cKDTree(places).query((some + others)[apart] / 2)[0].max() < 0.025 + step


def test_one_block_has_no_border():
    cells = Cells(FLAT, GRID, (0, 0, 0, 0))
    assert border_places(cells, np.array([-1.0, -1]), np.array([1.0, 1]), 0.1).shape == (0, 2)
