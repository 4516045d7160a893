"""What is left out as sky: skylines that are known, upright and on their side, and a house under a painted sky."""

from dataclasses import replace
from unittest import mock

import numpy as np
import torch

from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh import sky as module
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.sky import may_show_sky, sky, without_sky
from surfkit.mesh.tsdf import TSDF

from .shapes import look_at, maps_of, subject

UP = np.array([0.0, 0.0, 1.0])
EYES = [(4 * np.cos(turn), 4 * np.sin(turn), 0.3) for turn in np.linspace(0, 2 * np.pi, 12, endpoint=False)]


def house(points):
    """A box on the ground z = 0, from 0 to 1.2 high and 1.2 wide."""
    away = np.abs(points - [0, 0, 0.6]) - 0.6
    box = np.linalg.norm(np.maximum(away, 0), axis=-1) + np.minimum(away.max(-1), 0)
    return np.minimum(box, points[..., 2])


def skyline(camera, tops):
    """(H, W) bool known from the top of each column on, and what of the picture is sky."""
    rows = np.arange(camera.height)[:, None] + 0.5
    known = rows > tops
    return torch.from_numpy(known), torch.from_numpy(~known & (rows < camera.cy))


def test_what_lies_above_the_horizon_and_all_that_is_known_is_sky():
    camera = look_at((0.0, 0.0, 1.0), (0.0, 10.0, 1.0))
    tops = np.repeat([10, 30, 20, 72, 5, 50], 16)  # of 34 rows above the horizon; nothing is known of the fourth part
    known, expected = skyline(camera, tops)
    known[25:28, 40] = False  # a hole below what is known
    expected[25:28, 40] = False
    inner = np.abs(np.arange(96) % 16 - 7.5) < 5
    assert torch.equal(sky(camera, known, UP)[:, inner], expected[:, inner])
    assert expected[:, inner].float().mean() > 0.2


def test_a_photograph_on_its_side_has_the_same_sky():
    camera = look_at((0.0, 0.0, 1.0), (0.0, 10.0, 1.0), size=(72, 72))
    known, _ = skyline(camera, np.repeat([10, 30, 20], 24))
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[0.0, 1.0], [1.0, 0.0]])  # mirrored too: rows become columns
    side = replace(camera, world_to_camera=turn @ camera.world_to_camera, cx=camera.cy, cy=camera.cx)
    assert torch.equal(sky(side, known.T, UP).T, sky(camera, known, UP))


def test_views_that_look_down_show_no_sky_and_need_no_depth_maps():
    down = [look_at(2.5 * np.array([x, y, 1.6])) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    across = [*down, look_at(EYES[0])]
    assert not any(sky(camera, torch.zeros(72, 96, dtype=torch.bool), UP).any() for camera in down)
    for cameras, shown in ((down, False), (across, True)):
        given = subject(cameras, house)
        assert may_show_sky(given.views, UP) == shown
        assert TSDF(sky=False).needs_prior_of(given.views, given.frame) == shown
        assert TSDF(sky=False, trust=GeometricConsistency(priors="weigh")).needs_prior_of(given.views, given.frame)
        assert not TSDF().needs_prior_of(given.views, given.frame)
    with mock.patch.object(module, "emit") as told:
        given = subject(down, house)
        assert without_sky(given) is given and not told.called


def painted(cameras):
    """A house under a sky that all views see at a depth of 5, and depth priors that know the house and the ground."""
    given = subject(cameras, house)
    exact = {view.name: maps_of(view.camera, house) for view in given.views}
    maps, priors = {}, []
    for name, known in exact.items():
        depth = torch.where(known.depth > 0, known.depth, 5.0)
        away = torch.zeros_like(known.normal)
        away[2] = -1.0
        normal = torch.where(known.depth > 0, known.normal, away)
        maps[name] = replace(known, depth=depth, median=depth, normal=normal, alpha=torch.ones_like(depth))
        there = (known.depth > 0).float()
        priors.append(DepthPrior(there / known.depth.clamp_min(1e-9), there, 1.0))
    return replace(given, draw=lambda view: maps[view.name], priors=priors)


def test_a_painted_sky_is_no_surface():
    given = painted([look_at(eye, (0.0, 0.0, 0.6)) for eye in EYES])
    mesher = TSDF(voxel=0.4, truncation=1.0, depth_limit=80.0)
    far = np.abs(house(mesher.mesh(given).vertices)).max()
    left = replace(mesher, sky=False).mesh(given)
    assert far > 0.5 and np.abs(house(left.vertices)).max() < 0.05
    exact = mesher.mesh(subject([view.camera for view in given.views], house))
    assert len(left.faces) > 0.97 * len(exact.faces)
    assert replace(mesher, sky=False).needs_prior and not mesher.needs_prior


def test_views_without_a_depth_map_and_masks_are_as_they_were():
    given = painted([look_at(eye, (0.0, 0.0, 0.6)) for eye in EYES])
    mask = torch.zeros(72, 96, dtype=torch.bool)
    mask[:, 40:] = True
    kept = without_sky(replace(given, priors=[None, *given.priors[1:]], keep=lambda at: mask if at < 2 else None))
    solid = given.priors[2].confidence > 0
    assert torch.equal(kept.keep(0), mask)
    assert torch.equal(kept.keep(1), without_sky(given).keep(1) & mask) and (kept.keep(2) == solid).float().mean() > 0.9


def test_who_cannot_tell_the_sky_says_so():
    line = [look_at((x, 0.0, 1.0), (x, 10.0, 1.0)) for x in (0.0, 1.0, 2.0)]
    for given, why in (
        (replace(painted([look_at(eye) for eye in EYES]), priors=None), "no depth maps"),
        (painted(line), "which way is up"),
    ):
        with mock.patch.object(module, "emit") as told:
            assert without_sky(given) is given
        assert why in told.call_args.args[0].text
