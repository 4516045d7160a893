"""Depth maps of stochastic solids, against what these hide."""

from dataclasses import replace

import torch

from surfkit.mesh.solid_depth import solid_depth
from surfkit.raster.rays import ray_opacity
from surfkit.testing.inputs import mesh_input


def test_depth_is_where_half_is_left():
    given = mesh_input("gaussian", count=600, views=4)
    view = given.views[0]
    first = given.draw(view).median
    depth = solid_depth(given.splats, view.camera, given.near, first)
    seen = depth > 0
    assert seen.sum() > 0.8 * (first > 0).sum() and not (seen & (first == 0)).any()
    rays = view.camera.rays(torch.float64)
    pose = view.camera.world_to_camera

    def hidden(at):
        points = ((rays * at)[:, seen].T - pose[:3, 3]) @ pose[:3, :3]
        return ray_opacity(given.splats, view.camera, given.near, points, solid=True)

    # Across steps of the tails that are cut there is no place with just a half.
    assert ((hidden(depth.double()) - 0.5).abs() < 0.01).float().mean() > 0.95
    assert (hidden(depth.double() * 0.999) < 0.5).float().mean() > 0.99
    assert (hidden(depth.double() * 1.001) > 0.5).float().mean() > 0.99


def test_where_nothing_brackets_there_is_no_depth():
    given = mesh_input("gaussian", count=600, views=4)
    camera, median = given.views[0].camera, given.draw(given.views[0]).median
    faint = replace(given.splats, opacities=torch.full_like(given.splats.opacities, 0.01))
    assert not solid_depth(faint, camera, given.near, median).any()
    assert not solid_depth(given.splats, camera, given.near, 0 * median).any()
    assert not solid_depth(given.splats, camera, given.near, torch.where(median > 0, 100.0, 0.0)).any()
