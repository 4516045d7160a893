"""Levels by pruning: the points of highest importance, drawn as CityGaussian says."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.compress.levels import PrunedLevels
from surfkit.compress.levels.validate_levels import fault
from surfkit.core.check import BadInput
from surfkit.densify.prune import importance
from surfkit.testing.inputs import lod_input
from surfkit.train.view_order import ViewContributions

CELLS = 4


@pytest.fixture(scope="module")
def built():
    given = lod_input(count=800)
    params = given.model.params | {"scales": given.model.params["scales"] + torch.tensor([0.0, 1.0])}
    given = replace(given, model=replace(given.model, params=params))
    return given, PrunedLevels(tile_points=200, steps=0).build(given)


def test_the_most_important_points_stay(built):
    given, tree = built
    assert fault(tree, given.model) is None
    views = ViewContributions(given.views, given.rasterizer, given.model.splats, given.model.near)
    scores = importance(views, given.model.splats.detached(), 0.1)
    for level, share in zip(tree.levels[1:], (0.68, 0.5), strict=True):
        assert abs(len(level) - share * 800) <= CELLS
        least = scores.sort(descending=True).values[len(level) - 1 - CELLS]
        strong = given.model.splats.means[scores > least]
        kept = {tuple(row) for row in level.splats.means.tolist()}
        assert all(tuple(row) in kept for row in strong.tolist())


def rule(tree, camera):
    """Level of each cell as the released code chooses it: the finest whose mean scale is above two pixels."""
    blocks, found = tree.blocks, []
    leaves = [at for at in range(len(blocks)) if blocks.is_leaf[at]]
    for leaf in leaves:
        chain = [leaf]
        while blocks.level[chain[-1]] < len(tree.levels) - 1:
            chain.append(int(blocks.parent[chain[-1]]))
        top = chain[-1]  # the box of all levels of the cell
        centre = camera.centre.numpy()
        distance = np.linalg.norm(centre - np.clip(centre, blocks.low[leaf], blocks.high[leaf]))
        scales = [
            float(tree.levels[blocks.level[at]].splats.scales[blocks.first[at] : blocks.last[at]].mean(0).max())
            for at in chain
        ]
        above = [
            at for at, scale in zip(chain, scales, strict=True) if scale > 2 * distance / max(camera.fx, camera.fy)
        ]
        found.append(above[0] if above else top)
    return found


def test_the_level_of_a_cell_is_that_of_the_released_code(built):
    given, tree = built
    seen = set()
    for factor in np.geomspace(0.1, 100, 13):
        camera = given.views[4].camera
        camera = replace(camera, fx=camera.fx / factor, fy=camera.fy / factor)
        front = tree.blocks.front(camera, 1.0)
        if front.tolist() == [0]:
            assert set(tree.blocks.level[rule(tree, camera)]) == {2}
        else:
            assert sorted(front) == sorted(rule(tree, camera))
        seen |= set(tree.blocks.level[front].tolist())
    assert seen >= {0, 2}


def test_distances_in_metres():
    """One cell below a camera: from 30 m on the second level, from 60 m on the third, at the focal length of the
    photographs."""
    given = lod_input(count=300)
    given = replace(given, frame=replace(given.frame, metres=1.0))
    tree = PrunedLevels(distances=(30.0, 60.0), steps=0).build(given)
    assert len(tree.blocks) == 3
    camera, high = given.views[0].camera, tree.blocks.high[0]
    for metres, level in ((1, 0), (29, 0), (31, 1), (59, 1), (61, 2), (500, 2)):
        centre = torch.from_numpy((tree.blocks.low[0] + high) / 2)
        centre[2] = high[2] + metres / given.frame.local_metres
        pose = camera.world_to_camera.clone()
        pose[:3, 3] = -pose[:3, :3] @ centre
        front = tree.blocks.front(replace(camera, world_to_camera=pose), 1.0)
        assert tree.blocks.level[front].tolist() == [level], metres


def test_a_cell_that_matters_little_keeps_its_best_point():
    given = lod_input(count=200)
    far = {name: value.clone() for name, value in given.model.params.items()}
    far["means"][:100, 0] += 100  # no view sees these
    tree = PrunedLevels(tile_points=50, keep=(0.3,), steps=0).build(
        replace(given, model=replace(given.model, params=far))
    )
    sizes = (tree.blocks.last - tree.blocks.first)[tree.blocks.level == 1]
    assert sizes.min() == 1 and fault(tree, replace(given.model, params=far)) is None


@pytest.mark.parametrize(
    "settings, text",
    [
        ({"keep": ()}, "lod.keep"),
        ({"keep": (0.5, 0.6)}, "lod.keep"),
        ({"keep": (1.0,)}, "lod.keep"),
        ({"distances": (100.0,)}, "one for each of the 2 shares"),
        ({"distances": (200.0, 100.0)}, "rising"),
        ({"tile_points": 0}, "lod.tile_points"),
        ({"steps": -1}, "lod.steps"),
    ],
)
def test_wrong_settings(settings, text):
    with pytest.raises(BadInput, match=text):
        PrunedLevels(**settings)


def test_metres_must_be_known():
    given = lod_input(count=100)
    given = replace(given, frame=replace(given.frame, metres=None))
    with pytest.raises(BadInput, match="length .*--metres-per-unit"):
        PrunedLevels(distances=(200.0, 400.0), steps=0).build(given)
