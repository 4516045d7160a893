"""Boxes of splats that a view surely does not show, against the test of each splat."""

import pytest
import torch
from needs import needs_native

from surfkit.raster.api import Splats
from surfkit.raster.culling import boxes_may_touch, may_touch
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.scene.camera import Camera

NEAR = 0.01
KINDS = [("surfel", "axis"), ("gaussian", "axis"), ("gaussian", "ray")]


def splats(kind, geometry, seed, count=2_000, spread=3.0, far=0.0):
    """Small splats in all directions around the origin, in clusters of 8, some near the camera and some large."""
    draw = torch.Generator().manual_seed(seed)
    middles = torch.randn(count // 8, 1, 3, generator=draw) * spread
    means = (middles + 0.02 * torch.randn(count // 8, 8, 3, generator=draw)).reshape(-1, 3) + far
    columns = 2 if kind == "surfel" else 3
    scales = torch.exp(torch.randn(count, columns, generator=draw) - 4)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=draw), dim=1)
    return Splats(kind, means, quats, scales, torch.full((count,), 0.5), torch.zeros(count, 1, 3), geometry=geometry)


def camera(seed, far=0.0):
    """Looks anywhere, with a principal point out of the middle."""
    draw = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=draw, dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn).sign()
    pose = torch.eye(4, dtype=torch.float64)
    at = torch.randn(3, generator=draw, dtype=torch.float64) + far
    pose[:3, :3], pose[:3, 3] = turn, -turn @ at
    return Camera(pose, 90.0, 110.0, 50.0, 20.0, 120, 70)


@needs_native
@pytest.mark.parametrize("far", [0.0, 1e4])
@pytest.mark.parametrize(("kind", "geometry"), KINDS)
def test_no_box_of_a_splat_in_view_is_left_out(kind, geometry, far):
    left_out = []
    for seed in range(12):
        some, view = splats(kind, geometry, seed, far=far), camera(seed + 100, far)
        shown = boxes_may_touch(SplatBoxes.of(some, 8), view, NEAR)
        for found in (NativeRasterizer().in_view(some, view, NEAR), may_touch(some, view, NEAR)):
            assert not (found.view(-1, 8).any(1) & ~shown).any()
        left_out.append(1 - float(shown.float().mean()))
    assert sum(left_out) / len(left_out) > (0.6 if far == 0 else 0.3), "most boxes are out of view"


def test_boxes_are_widened_and_hold_a_block_that_is_not_full():
    some = splats("surfel", "axis", 3, count=24)
    part = some.take(torch.arange(21))
    boxes = SplatBoxes.of(part, 8)
    assert torch.equal(boxes.low[2], part.means[16:].amin(0)) and torch.equal(boxes.high[2], part.means[16:].amax(0))
    boxes.widen(torch.tensor([0, 2]), some.take(torch.tensor([22, 23])))
    assert (boxes.low[0] <= some.means[22]).all() and (boxes.high[0] >= some.means[22]).all()
    assert float(boxes.scale[2]) == max(float(part.scales[16:].max()), float(some.scales[23].max()))
