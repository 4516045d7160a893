"""Boxes in pictures, against their outlines: corners projected in float64, their hull cut by the picture."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from surfkit.partition import Airspace, CameraGrid, PictureShare
from surfkit.partition.airspace import filled
from surfkit.partition.base import Ground
from surfkit.partition.plan import BlockMinimums, plan
from surfkit.raster.api import Splats
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.testing.inputs import above, coarse_model

LEVEL = torch.eye(3, dtype=torch.float64)


def outlined(camera: Camera, low: np.ndarray, high: np.ndarray) -> float:
    """The part of the picture inside the outline of a box, of which the part behind the camera is cut off first."""
    pose, near = camera.world_to_camera.numpy(), 1e-6
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    local = corners @ pose[:3, :3].T + pose[:3, 3]
    shown = [p for p in local if p[2] >= near]
    for a in range(8):
        for b in range(a):
            if bin(a ^ b).count("1") == 1 and (local[a, 2] < near) != (local[b, 2] < near):
                t = (near - local[a, 2]) / (local[b, 2] - local[a, 2])
                shown.append(local[a] + t * (local[b] - local[a]))
    if len(shown) < 3:
        return 0.0
    at = np.array([[camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy] for x, y, z in shown])
    outline = at[ConvexHull(at, qhull_options="QJ").vertices]
    for axis, side, sign in ((0, 0, 1), (0, camera.width, -1), (1, 0, 1), (1, camera.height, -1)):
        inside, kept = sign * (outline[:, axis] - side), []
        for i in range(len(outline)):
            if inside[i - 1] * inside[i] < 0:
                t = inside[i - 1] / (inside[i - 1] - inside[i])
                kept.append(outline[i - 1] + t * (outline[i] - outline[i - 1]))
            if inside[i] >= 0:
                kept.append(outline[i])
        outline = np.array(kept).reshape(-1, 2)
        if not len(outline):
            return 0.0
    x, y = outline.T
    return abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2 / (camera.width * camera.height)


def turned(eye: np.ndarray, draws: np.random.Generator) -> Camera:
    """A camera at a place that looks anywhere, with pixels that are not square and a centre that is off."""
    rotation = np.linalg.qr(draws.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return Camera(torch.from_numpy(pose), 60.0, 65.0, 40.0, 37.0, 96, 64)


def test_what_boxes_fill_as_outlines_do():
    """Cameras around boxes, many of which reach behind them; sides off the axes of the frame."""
    draws, found, expected = np.random.default_rng(0), [], []
    axes = np.linalg.qr(draws.normal(size=(3, 3)))[0]
    while len(found) < 1_000:
        low = draws.uniform(-1, 0, 3)
        high, eye = low + draws.uniform(0.1, 1.5, 3), draws.normal(size=3) * 1.2
        if ((eye >= low) & (eye <= high))[:2].all():
            continue
        camera = turned(eye, draws)
        seen = replace(camera, world_to_camera=camera.world_to_camera.clone())
        seen.world_to_camera[:3, :3] = camera.world_to_camera[:3, :3] @ torch.from_numpy(axes)
        found.append(filled(seen, torch.from_numpy(axes), torch.from_numpy(low), torch.from_numpy(high)))
        expected.append(outlined(camera, low, high))
    assert np.count_nonzero(np.array(expected) > 0.05) > 100 < np.count_nonzero(np.array(expected) == 0)
    assert np.abs(np.array(found) - expected).max() < 0.02


def test_a_box_from_above():
    """A camera 2 above the ground, beside a box of height 1: its roof is at depth 1, its foot hides behind it."""
    camera = above(0.0, 0.0, 2.0)  # 48 x 40 pixels, focal 50: the picture spans 0.96 x 0.8 at depth 1
    low, high = torch.tensor([0.12, -1.0, 0.0]).double(), torch.tensor([2.0, 1.0, 1.0]).double()
    # From its roof's near side, x = 0.12 at depth 1, or its foot's, x = 0.12 at depth 2: 0.06 at depth 1, to 0.48.
    assert filled(camera, LEVEL, low, high) == pytest.approx((0.48 - 0.06) / 0.96, abs=0.5 / 48)
    assert filled(camera, LEVEL, low - torch.tensor([1.0, 0, 0]).double(), high) == 1.0, "the camera is above it"
    flat = replace(camera, world_to_camera=torch.eye(4).double())
    assert filled(flat, LEVEL, low, high * torch.tensor([1, 1, 0]).double()) == 0.0, "behind, and without height"


def towers() -> Splats:
    """Two fields of points, of which the left one, x from -1 to 0, is 0.3 high, and one point far off and high."""
    draws = torch.Generator().manual_seed(0)
    means = torch.rand(4_000, 3, generator=draws) * torch.tensor([1.0, 1.0, 0.3])
    means[:2_000, 0] -= 1
    means[0] = torch.tensor([-30.0, 0.5, 7.0])
    means[2_000:, 2] = 0
    quats = torch.tensor([1.0, 0, 0, 0]).expand(4_000, 4).contiguous()
    size, opaque = torch.full((4_000, 2), 0.01), torch.full((4_000,), 0.5)
    return Splats("surfel", means, quats, size, opaque, torch.zeros(4_000, 1, 3))


def test_the_space_of_a_block_is_that_of_nearly_all_its_points():
    """Two blocks, x below 0 and above: the first has height, and a stray point; grown by a fifth."""
    cameras = [above(x, 0.5, 1.0) for x in (-0.5, 0.05, 0.15, 0.5, 2.0)]
    sight = replace(
        coarse_model(200), splats=towers(), views=[View(str(i), c, path=None) for i, c in enumerate(cameras)]
    )
    owner = (sight.splats.means[:, 0] > 0).long()
    assert Ground.under(sight.centres, sight.splats.means) == Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    share = Airspace().measure(sight, owner, 3).numpy()
    assert share[:2, 0].tolist() == [1, 1], "inside, and inside a tenth of its length beside it"
    assert share[1:4, 1].tolist() == [1, 1, 1] and share[0, 1] < 0.25
    for at, (block, low, high) in {
        2: (0, (-1.1, -0.1, 0.0), (0.1, 1.1, 0.3)),
        3: (0, (-1.1, -0.1, 0.0), (0.1, 1.1, 0.3)),
        0: (1, (-0.1, -0.1, 0.0), (1.1, 1.1, 1e-9)),
        4: (1, (-0.1, -0.1, 0.0), (1.1, 1.1, 1e-9)),
    }.items():
        expected = outlined(cameras[at], np.array(low), np.array(high))
        assert share[at, block] == pytest.approx(expected, abs=0.03), at
    assert (share[:, 2] == 0).all(), "a block without points has no space"


def test_a_view_through_the_air_joins_though_it_shows_no_point():
    """A level view over the low roofs and past the single tower: its share of points is nothing."""
    draws = torch.Generator().manual_seed(1)
    sight, means = coarse_model(4_000), torch.rand(4_000, 3, generator=draws) * torch.tensor([2.0, 2.0, 0.01]) - 1
    means[:, 2] += 1
    means[:60, :] = torch.rand(60, 3, generator=draws) * torch.tensor([0.02, 0.02, 0.5]) + torch.tensor([0.7, 0.7, 0.0])
    means[60:120, :] = means[:60] - torch.tensor([1.4, 1.4, 0.0])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # looks along -x, z up
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0.5, -0.3, 0.25], dtype=torch.float64)
    level = View("level.png", Camera(pose, 50.0, 50.0, 24.0, 39.0, 48, 40), path=None)  # above the horizon
    sight = replace(sight, splats=replace(sight.splats, means=means), views=(*sight.views, level))
    way, fewest = CameraGrid((2, 1)), BlockMinimums(1, 0, 0)
    by_air, by_share = (plan(sight, way, assign, fewest).blocks for assign in (Airspace(), PictureShare(0.25)))
    assert "level.png" in by_air[0].views and "level.png" not in by_share[0].views
    assert {view.name for view in sight.views} == {name for block in by_air for name in block.views}
