"""Parts that make levels of detail and break their contract are named, with what is wrong."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from surfkit.compress.levels import LevelsOfDetail, MergedLevels
from surfkit.compress.levels.lod_tree import LodBlock, LodTree
from surfkit.testing import check_levels_of_detail


@dataclass(frozen=True)
class Halves(LevelsOfDetail):
    """Half of the points from afar."""

    def build(self, given):
        count = len(given.model)
        half = {name: value[: count // 2] for name, value in given.model.params.items()}
        levels = [given.model, replace(given.model, params=half)]
        return self.spoilt(
            LodTree.of(np.arange(count), levels, [LodBlock(1, 0, count // 2, -1, 0.1), LodBlock(0, 0, count, 0, 0)])
        )

    def spoilt(self, tree):
        return tree


class Mutates(Halves):
    def build(self, given):
        given.model.params["means"] += 1
        return Halves.build(self, given)


class Lists(Halves):
    def spoilt(self, tree):
        return list(tree.levels)


class Loses(Halves):
    def spoilt(self, tree):
        return replace(tree, order=tree.order[:-1])


class Grows(Halves):
    def spoilt(self, tree):
        twice = {name: torch.cat([value, value]) for name, value in tree.levels[0].params.items()}
        return replace(tree, levels=(tree.levels[0], replace(tree.levels[0], params=twice)))


class Uncovered(Halves):
    def spoilt(self, tree):
        return replace(tree, blocks=replace(tree.blocks, last=tree.blocks.last // 2))


class Rises(Halves):
    def spoilt(self, tree):
        return replace(tree, blocks=replace(tree.blocks, error=np.array([0.1, 0.2])))


class Boxes(Halves):
    def spoilt(self, tree):
        return replace(tree, blocks=replace(tree.blocks, low=tree.blocks.low + np.array([[1.0], [0.0]])))


class Infinite(Halves):
    def spoilt(self, tree):
        return replace(tree, blocks=replace(tree.blocks, error=np.array([np.inf, 0.0])))


class Draws(Halves):
    def spoilt(self, tree):
        means = tree.levels[1].params["means"] + torch.rand(1)
        level = replace(tree.levels[1], params=tree.levels[1].params | {"means": means})
        return replace(tree, levels=(tree.levels[0], level))


WRONG = {
    Mutates: "changed its input params",
    Lists: "gives a list, not a LodTree",
    Loses: "not each of the",
    Grows: "more points than the one before: 400, 800",
    Uncovered: "each point of the first",
    Rises: "error above 0",
    Boxes: "outside that of its parent",
    Infinite: "a box or an error is not finite",
    Draws: "is not repeatable",
}


def test_sound_ones_pass():
    check_levels_of_detail(Halves())
    check_levels_of_detail(MergedLevels(tile_points=200, steps=0))


@pytest.mark.parametrize("wrong", WRONG, ids=lambda cls: cls.__name__)
def test_wrong_ones_are_named(wrong):
    with pytest.raises(AssertionError, match=WRONG[wrong]):
        check_levels_of_detail(wrong())
