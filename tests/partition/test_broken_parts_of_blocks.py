"""Partitions and assignments of a plugin that break their contract are named in one line: a place in two cells would
belong to the block of the last one, without a word."""

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.partition.base import Cells, Ground
from surfkit.partition.plan import plan
from surfkit.testing.inputs import coarse_model

GROUND = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
LEFT, RIGHT = (None, None, 0.0, None), (0.0, None, None, None)


def test_cells_that_tile_the_ground():
    assert Cells(GROUND, (LEFT, (0.0, None, None, 1), (0.0, 1, None, None)), (0, 1, 1)).count == 2


@pytest.mark.parametrize(
    ("boxes", "blocks", "said"),
    [
        ((LEFT, (0.1, None, None, None)), (0, 1), "some place on the ground is in none of the cells"),
        (((None, None, 0.1, None), RIGHT), (0, 1), "some place on the ground is in several cells"),
        (((0.5, None, -0.5, None), LEFT, RIGHT), (0, 1, 2), "box 0 is .*; its upper x and y must be above"),
        ((LEFT, (0.0, None, 1.0, None)), (0, 1), "in none of the cells; each must be in exactly one, far away too"),
        (((None, None, float("nan"), None), RIGHT), (0, 1), "box 0 is .*nan"),
        ((LEFT, (torch.tensor(0.0), None, None, None)), (0, 1), "box 1 is .*tensor"),
        ((LEFT, (0.0, None, None)), (0, 1), "box 1 is .*; give lower x and y, upper x and y, numbers or None"),
        ((LEFT, RIGHT), (0.0, 1.0), "give whole numbers, counted from 0"),
    ],
)
def test_cells_that_do_not(boxes, blocks, said):
    with pytest.raises(BadInput, match=said) as error:
        plan(coarse_model(), Given(Cells(GROUND, boxes, blocks)), Given())
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("x", [(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (0.6, 0.8, 0.0)])
def test_the_ground_has_unit_axes(x):
    with pytest.raises(BadInput, match="they must have length 1 and be perpendicular"):
        Ground(x, (0.0, 1.0, 0.0))


class Given:
    """A partition and an assignment that give what they are told to."""

    most_views = None

    def __init__(self, cells=None, joins=None):
        self.cells, self.joins = lambda sight: cells, lambda sight, cells: joins


@pytest.mark.parametrize(
    ("joins", "said"),
    [
        (lambda count: torch.rand(count, 2), r"joins: expected a tensor of bool .* got a tensor of float32"),
        (lambda count: torch.ones(2, count).bool(), r"joins: expected shape \(\d+, 2\), got \(2, \d+\)"),
        (lambda count: torch.ones(count, 1).bool(), r"joins: expected shape \(\d+, 2\), got \(\d+, 1\)"),
        (lambda count: None, "joins: expected a tensor of bool .* got NoneType"),
    ],
)
def test_joins(joins, said):
    sight = coarse_model()
    with pytest.raises(BadInput, match=said):
        plan(sight, Given(Cells(GROUND, (LEFT, RIGHT), (0, 1))), Given(joins=joins(len(sight.views))))


def test_no_cells():
    with pytest.raises(BadInput, match="Given.cells: expected Cells, got NoneType"):
        plan(coarse_model(), Given(), Given())
