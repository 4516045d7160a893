"""The blocks that are drawn for a view: the front of the tree, against a search that looks at each block."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.compress.levels import MergedLevels
from surfkit.compress.levels.lod_tree import LodBlock, LodTree
from surfkit.compress.levels.validate_levels import fault
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame
from surfkit.testing.inputs import lod_input


@pytest.fixture(scope="module", params=[Surfel2D(sh_degree=1), Gaussian3D(sh_degree=0)], ids=["surfels", "gaussians"])
def built(request):
    given = lod_input(request.param, count=800)
    return given, MergedLevels(tile_points=50, steps=0).build(given)


def random_camera(draw, size=60):
    z = torch.nn.functional.normalize(torch.randn(3, generator=draw, dtype=torch.float64), dim=0)
    x = torch.linalg.cross(z, torch.randn(3, generator=draw, dtype=torch.float64))
    x = x / x.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ torch.randn(3, generator=draw, dtype=torch.float64)
    return Camera(pose, 1.1 * size, size, 0.4 * size, 0.6 * size, size, size // 2)


def wanted(tree, camera, pixels, at=0):
    """The front by going down from the root: a block, or what its children give."""
    blocks = tree.blocks
    children = (blocks.parent == at).nonzero()[0]
    centre = camera.centre.numpy()
    nearest = np.clip(centre, blocks.low[at], blocks.high[at])
    distance = np.linalg.norm(centre - nearest)
    if not len(children) or blocks.error[at] * max(camera.fx, camera.fy) <= pixels * distance:
        return [at]
    return [found for child in children for found in wanted(tree, camera, pixels, child)]


def test_the_front_is_that_of_a_search_from_the_root(built):
    _, tree = built
    draw = torch.Generator().manual_seed(0)
    sizes = set()
    for pixels in (0.0, 0.3, 1.0, 3.0, 10.0, 1e6):
        for _ in range(10):
            camera = random_camera(draw)
            front = tree.blocks.front(camera, pixels)
            assert sorted(wanted(tree, camera, pixels)) == front.tolist()
            sizes.add(len(front))
    assert {1, int(tree.blocks.is_leaf.sum())} < sizes, "the whole, the finest, and some between"


def test_the_finest_front_within_a_budget(built):
    _, tree = built
    blocks, draw = tree.blocks, torch.Generator().manual_seed(2)
    points = blocks.last - blocks.first
    for _ in range(10):
        camera = random_camera(draw)
        errors = blocks.pixels(camera)
        fronts = [blocks.front(camera, pixels) for pixels in sorted({*errors[np.isfinite(errors)], 0.0})]
        for budget in (50, 120, 333, 799, 800):
            within = [front for front in fronts if points[front].sum() <= budget]
            found = blocks.front_within(errors, points, budget)
            assert points[found].sum() <= budget
            assert found.tolist() == (within[0].tolist() if within else [0]), "the root is all that is left"
        assert blocks.front_within(errors, points, int(points[0]) - 1) is None


def test_every_point_is_drawn_once_or_stood_for(built):
    _, tree = built
    above = {at: {at} for at in range(len(tree.blocks))}
    for at in range(1, len(tree.blocks)):
        above[at] |= above[int(tree.blocks.parent[at])]
    leaves = tree.blocks.is_leaf.nonzero()[0]
    camera = random_camera(torch.Generator().manual_seed(4))
    for pixels in (0.0, 0.5, 2.0, 1e6):
        front = set(tree.blocks.front(camera, pixels).tolist())
        assert all(len(above[leaf] & front) == 1 for leaf in leaves)


def test_blocks_that_a_view_does_not_see_are_not_missed(built):
    given, tree = built
    draw = torch.Generator().manual_seed(1)
    near, left_out = tree.levels[0].near, 0
    for _ in range(20):
        camera = random_camera(draw)
        everywhere = tree.blocks.front(camera, 2.0)
        seen = tree.blocks.front(camera, 2.0, near)
        assert set(seen) <= set(everywhere)
        left_out += len(everywhere) - len(seen)
        pictures = [
            given.rasterizer.render(tree.joined.take(tree.rows(front)), camera, near, False, False).maps.color
            for front in (everywhere, seen)
        ]
        assert torch.equal(*pictures)
    assert left_out > 50


def test_the_finest_front_is_the_model(built):
    given, tree = built
    camera = given.views[0].camera
    rows = tree.rows(tree.blocks.front(camera, 0.0))
    assert sorted(tree.order[rows.numpy()]) == list(range(len(given.model)))
    assert torch.equal(tree.joined.take(rows).means, given.model.splats.means[torch.from_numpy(tree.order)[rows]])


def test_a_camera_that_sees_nothing(built):
    _, tree = built
    camera = random_camera(torch.Generator().manual_seed(0))
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = -1e4  # everything is behind it
    assert len(tree.seen(replace(camera, world_to_camera=pose), 1.0)) == 0


def test_tiles_in_the_frame_of_the_input(built):
    given, tree = built
    frame = Frame(np.array([5e5, 6e6, 100.0]), 0.01)
    root = tree.tiles(frame)
    tables = [root]
    for tile in tables:
        tables += tile.children
    leaves = [tile for tile in tables if not tile.children]
    assert len(tables) == len(tree.blocks) and sum(len(tile.splats) for tile in leaves) == len(given.model)
    for tile in tables:
        means = tile.splats.means.numpy()
        assert means.dtype == np.float64
        assert (means >= tile.low - 1e-6).all() and (means <= tile.high + 1e-6).all()
        assert (tile.error == 0) == (not tile.children)
        for child in tile.children:
            assert tile.error >= child.error and (tile.low <= child.low).all() and (tile.high >= child.high).all()
    assert root.error == pytest.approx(100 * tree.blocks.error[0])
    everything = given.model.primitive.table(given.model.params).in_input_frame(frame)
    assert torch.equal(
        torch.cat([tile.splats.means for tile in leaves]).sort(0).values, everything.means.sort(0).values
    )


def test_what_is_wrong_with_a_tree(built):
    given, tree = built
    assert fault(tree, given.model) is None
    levels, blocks = tree.levels, tree.blocks
    wrong = {
        "not each of the": replace(tree, order=np.zeros_like(tree.order)),
        "other values": replace(tree, order=tree.order[::-1].copy()),
        "more points": replace(tree, levels=(levels[0], *levels[:0:-1])),
        "not finite": replace(tree, levels=(*levels[:-1], spoilt(levels[-1], float("nan")))),
        "rows that are not there": replace(tree, blocks=replace(blocks, last=blocks.last + 1)),
        "do not hold each point": replace(
            tree, blocks=replace(blocks, last=np.where(blocks.is_leaf, blocks.last - 1, blocks.last))
        ),
        "not the root": replace(tree, blocks=replace(blocks, parent=blocks.parent[::-1].copy())),
        "error above 0": replace(tree, blocks=replace(blocks, error=np.full(len(blocks), 1.0))),
        "below that of its children": replace(
            tree, blocks=replace(blocks, error=np.where(blocks.parent < 0, 0, blocks.error))
        ),
        "outside that of its parent": replace(
            tree, blocks=replace(blocks, high=blocks.high + np.arange(len(blocks))[:, None])
        ),
    }
    for text, spoilt_tree in wrong.items():
        assert text in (fault(spoilt_tree, given.model) or ""), text


def spoilt(level, value):
    means = level.params["means"].clone()
    means[0] = value
    return replace(level, params=level.params | {"means": means})


def test_errors_and_boxes_are_raised_to_those_below():
    given = lod_input(count=100)
    tree = LodTree.of(
        np.arange(100),
        [given.model, given.model],
        [
            LodBlock(1, 0, 100, -1, 0.1),
            LodBlock(1, 0, 50, 0, 0.3),
            LodBlock(0, 0, 50, 1, 0.0),
            LodBlock(0, 50, 100, 0, 0.0),
        ],
    )
    assert tree.blocks.error.tolist() == [0.3, 0.3, 0.0, 0.0]
    means = given.model.splats.means.double().numpy()
    assert np.array_equal(tree.blocks.low[0], means.min(0)) and np.array_equal(tree.blocks.high[3], means[50:].max(0))
