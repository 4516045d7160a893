"""What views know of each other's depth: analytic walls, seen by views of which one is wrong."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh import native_grid as native
from surfkit.mesh import tsdf
from surfkit.mesh.fusion_image import weighed
from surfkit.mesh.geometric_consistency import GeometricConsistency, compare, compare_in_torch
from surfkit.mesh.overlap import Depths, nearby, overlapping
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Maps
from surfkit.scene.scene import View

from .shapes import around, look_at, maps_of, seen, sphere, subject
from .test_tsdf import cut_in_eight, faces_by_place

TRUST = GeometricConsistency()


def wall(points):
    """Solid below z = 0."""
    return points[..., 2]


def box(points):
    """A box on the ground z = 0: 0.6 wide, 0.4 high."""
    away = np.abs(points - [0, 0, 0.2]) - [0.3, 0.3, 0.2]
    outside = np.linalg.norm(np.maximum(away, 0), axis=-1)
    return np.minimum(points[..., 2], outside + np.minimum(away.max(-1), 0))


def facing(count=4, shape=wall):
    """Cameras 2 above the wall that look straight at it from places 0.35 apart (10 degrees), and exact depths."""
    cameras = [look_at((0.35 * at, 0.1, 2.0), (0.35 * at, 0.1001, 0.0)) for at in range(count)]
    return cameras, [torch.from_numpy(seen(camera, shape)[0]).float() for camera in cameras]


def test_exact_views_agree_and_wrong_depths_are_contradicted():
    (one, other, *_), (depth, there, *_) = facing()
    agreement, against, looks = compare(one, depth, other, there, 0.01)
    x = one.rays(torch.float64)[0] * 2  # where each pixel hits the wall, across
    u = other.fx * (x - 0.35) / 2 + other.cx
    covered = (u > 1) & (u < 95)
    near = (u - 96 * (u > 48)).abs() < 1  # the rim of the picture, within rounding
    assert torch.equal(looks.bool() | near, ((u >= 0) & (u < 96)) | near) and 0.5 < looks.mean() < 1
    assert not compare(one, depth, other, 0 * there, 0.01)[2].any(), "without depth a view does not count"
    turned = (other.fx * (x + 0.35) / 2 + other.cx > 1) & (other.fx * (x + 0.35) / 2 + other.cx < 95)
    assert (agreement[covered] > 0.99).all() or (agreement[turned] > 0.99).all()
    assert 0.5 < (agreement > 0.99).float().mean() < 1 and not against.any()
    for wrong in (0.7, 1.4):  # before the wall the other sees through it; behind it, this one sees through the wall
        agreement, against, _ = compare(one, wrong * depth, other, there, 0.01)
        assert not agreement.any() and against.float().mean() > 0.4, wrong


def test_what_something_hides_is_not_contradicted():
    """The foot of a wall behind which another view stands: nothing speaks against it."""
    one, other = look_at((0.9, 0.0, 2.0), (0.4, 0.0, 0.0)), look_at((-0.9, 0.0, 2.0), (0.0, 0.0, 0.2))
    depth, there = (torch.from_numpy(seen(camera, box)[0]).float() for camera in (one, other))
    agreement, against, looks = compare(one, depth, other, there, 0.01)
    points = one.rays(torch.float64) * depth.double()
    pose = one.world_to_camera
    world = torch.einsum("ji,jhw->ihw", pose[:3, :3], points - pose[:3, 3][:, None, None])
    hidden = (world[0] > 0.31) & (world[0] < 0.38) & (world[1].abs() < 0.2) & (world[2].abs() < 0.05)
    assert hidden.sum() > 20 and not against[hidden].any() and not agreement[hidden].any()
    assert looks[hidden].all(), "and yet the other view looks that way"
    assert against.float().mean() < 0.02 and agreement.float().mean() > 0.3


def test_a_pixel_beside_an_edge_contradicts_nothing():
    """A bar of the nearer depth that is one pixel wide, and where the other view has it in the next column."""
    one, other = (look_at((0.0, 0.1, 2.0), (0.0, 0.1001, 0.0)) for _ in range(2))
    depth = torch.full((one.height, one.width), 2.0)
    there = depth.clone()
    depth[:, 40], there[:, 41] = 1.5, 1.5
    for first, second in ((depth, there), (there, depth)):
        assert not compare(one, first, other, second, 0.01)[1].any()
    there[:, 41], there[:, 43] = 2.0, 1.5  # further away, each sees through the other's
    against = compare(one, depth, other, there, 0.01)[1]
    assert against[:, 40].all() and not against[:, 46:].any()


@needs_native
@pytest.mark.parametrize("tolerance", [0.01, 0.1])
def test_compiled_comparison_is_that_in_torch(tolerance, rng=np.random.default_rng(3)):
    cameras = [look_at((0.9, 0.0, 2.0), (0.4, 0.0, 0.0)), look_at((-0.9, 0.3, 2.0), (0.0, 0.0, 0.2))]
    cameras += [replace(cameras[1].resized(50, 41), cy=30.0), look_at((0.4, 0.0, -1.0), (0.4, 0.1, 0.0))]  # from below
    depths = [torch.from_numpy(seen(camera, box)[0]).float() for camera in cameras]
    for depth in depths:  # in squares, as what all pixels around show counts too
        wrong = rng.choice([0, 0.7, 0.95, 1, 1, 1.02, 1.5], [-(-side // 4) for side in depth.shape])
        depth *= torch.from_numpy(wrong.repeat(4, 0).repeat(4, 1)[: depth.shape[0], : depth.shape[1]]).float()
    found = [
        (compare(one, depth, other, there, tolerance), compare_in_torch(one, depth, other, there, tolerance))
        for one, depth in zip(cameras, depths, strict=True)
        for other, there in zip(cameras, depths, strict=True)
    ]
    ours, expected = (
        torch.cat([torch.stack(each).flatten(1) for each in all_of], 1) for all_of in zip(*found, strict=True)
    )
    assert (expected > 0).float().mean(1).min() > 0.02 and (expected == 0).float().mean(1).min() > 0.3
    assert ((ours - expected).abs() < 1e-4).all(0).float().mean() > 0.999, "but where rounding takes another pixel"


def with_maps(cameras, depths):
    """A subject of these depth maps; the normals are those of the wall."""
    given = subject(cameras, wall)
    maps = {}
    for at, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        exact = maps_of(camera, wall)
        maps[f"{at}"] = replace(exact, depth=depth, median=depth)
    return replace(given, draw=lambda view: maps[view.name])


@pytest.mark.parametrize(("wrong", "carve"), [(0.6, False), (1.8, True)])
def test_a_view_that_is_wrong_carves_no_hole_into_a_wall_that_three_others_see(wrong, carve):
    cameras, depths = facing(4)
    spoilt = depths[1].clone()
    spoilt[20:52, 30:66] *= wrong  # sees through the wall there, or something before it
    mesher = TSDF(voxel=0.3, truncation=1.2, depth_limit=50.0, least_views=0.5, carve=carve)
    views = with_maps(cameras, [depths[0], spoilt, *depths[2:]])
    exact = mesher.mesh(with_maps(cameras, depths)).vertices
    plain = mesher.mesh(views).vertices
    judged = replace(mesher, trust=TRUST).mesh(views).vertices
    assert np.abs(plain[:, 2]).max() > 0.03, "without trust it shows"
    assert np.abs(judged[:, 2]).max() < 0.012, "what there is lies at the rim of the wrong place, within a pixel"
    assert covered(exact) and covered(exact) == covered(judged), "and no hole"


def covered(vertices):
    """Squares of the part of the wall that three views or more see, with a vertex in them."""
    some = vertices[(np.abs(vertices[:, 0] - 0.5) < 0.6) & (np.abs(vertices[:, 1]) < 0.5)]
    return {(int(x), int(y)) for x, y in np.floor(some[:, :2] / 0.06)}


def test_what_nobody_else_sees_keeps_a_low_weight_and_what_is_contradicted_none():
    cameras, depths = facing(4)
    far = look_at((30.0, 0.1, 2.0), (30.0, 0.1001, 0.0))
    depths_at = [*depths, torch.full((72, 96), 2.0)]
    found = [TRUST.among(at, Depths([*cameras, far], depths_at.__getitem__)) for at in range(5)]
    assert (found[4] == TRUST.alone).all()
    assert (found[1] == 1).float().mean() > 0.5 and set(found[1].unique().tolist()) <= {0.25, 0.5, 1.0}
    spoilt = depths[1].clone()
    spoilt[30:40, 40:60] *= 1.3
    depths_at[1] = spoilt
    trust = TRUST.among(1, Depths([*cameras, far], depths_at.__getitem__))
    assert not trust[32:38, 44:56].any() and (trust[:20] > 0).all()
    depths_at[1] = torch.zeros(72, 96)
    assert not TRUST.among(1, Depths([*cameras, far], depths_at.__getitem__)).any()


@pytest.mark.parametrize(("count", "least"), [(2, 1), (3, 1), (5, 2)])
def test_places_in_the_pictures_of_too_few_views_are_left_out(count, least):
    """By where each pixel hits the wall, and which pictures show that; of views that show little in common, all stays
    that one other view shows."""
    cameras, depths = facing(count)
    found = replace(TRUST, covered_by=2).among(0, Depths(cameras, depths.__getitem__))
    pose, rays = cameras[0].world_to_camera, cameras[0].rays(torch.float64)
    ways = torch.einsum("ji,jhw->ihw", pose[:3, :3], rays)
    hits = (cameras[0].centre[:, None, None] - ways * (cameras[0].centre[2] / ways[2])).reshape(3, -1).T
    shown, rim = torch.zeros(len(hits)), torch.zeros(len(hits), dtype=torch.bool)
    for other in cameras[1:]:
        u, v, _ = other.project(hits).unbind(1)
        shown += (u >= 0) & (u < 96) & (v >= 0) & (v < 72)
        rim |= (u.abs() < 1) | ((u - 96).abs() < 1) | (v.abs() < 1) | ((v - 72).abs() < 1)
    kept = (found > 0).reshape(-1)
    assert torch.equal(kept[~rim], (shown >= least)[~rim]) and 0.3 < kept.float().mean() < 0.95
    alone = replace(TRUST, covered_by=2).among(0, Depths(cameras[:1], depths.__getitem__))
    assert (alone == TRUST.alone).all(), "a single view has nobody to compare with"


def test_neighbours_look_from_the_wanted_angle_and_see_the_same():
    cameras = [look_at((2 * np.tan(np.radians(a)), 0.1, 2.0), (0.0, 0.1001, 0.0)) for a in (0, 0.5, 3, 12, 14, -12, 70)]
    behind = look_at((0.1, 0.1, -2.0), (0.0, 0.1001, -4.0))
    depths = [torch.from_numpy(seen(camera, wall)[0]).float() for camera in cameras] + [torch.zeros(72, 96)]
    views = Depths([*cameras, behind], depths.__getitem__)
    first = overlapping(0, views, 2, 12.0)
    assert set(first) <= {3, 4, 5} and 5 in first, "from both sides"
    every = overlapping(0, views, 8, 12.0)
    assert not {1, 6, 7} & set(every) and every[:2] == first, "from half a degree aside, nothing confirms anything"
    assert overlapping(7, views, 8, 12.0) == []


def test_nearby_views_are_those_of_a_search_through_all():
    places = np.random.default_rng(0).uniform(-10, 10, (300, 3)).round(1)  # some as far away as others
    cameras = [look_at(tuple(place), tuple(place + [0.1, 0.2, 1])) for place in places]
    views = Depths(cameras, lambda at: torch.zeros(1, 1))
    for at, reach in ((0, 0.0), (3, 4.0), (7, 30.0)):
        apart = np.linalg.norm(views.centres - views.centres[at], axis=1)
        order = np.argsort(apart, kind="stable")
        most = 2 * np.tan(np.radians(22.5)) * reach
        found = [int(i) for i in order if apart[i] <= most and i != at]
        assert nearby(at, views, reach) == found[:: -(-len(found) // 128) or 1]


def test_alpha_spread_and_priors_tell():
    depth = torch.full((4, 6), 2.0)
    alpha = torch.full((4, 6), 0.9)
    alpha[0] = 0.4
    expected = depth.clone()
    expected[1] = 2.1
    maps = Maps(None, alpha, alpha * expected, depth)
    assert not TRUST.within(maps, depth, None)[0].any() and (TRUST.within(maps, depth, None)[1:] == 1).all()
    spread = GeometricConsistency(spread=0.05).within(maps, depth, None)
    assert torch.allclose(spread[1], torch.tensor(0.5)) and torch.allclose(spread[2:], torch.tensor(1.0))
    inverse, confidence = torch.full((4, 6), 0.5), torch.ones(4, 6)
    inverse[2], inverse[3, 3:] = 0.4, 0
    confidence[:, 1], confidence[:, 2] = 0.5, 0.1
    told = GeometricConsistency(priors="weigh").within(maps, depth, DepthPrior(inverse, confidence, 0.5))
    assert told[3, :3].tolist() == pytest.approx([2.0, 1.5, 1.1]) and told[3, 3:].tolist() == [1, 1, 1]
    assert told[2].tolist() == [0, 0, 1, 0, 0, 0], "a prior that is not confident contradicts nobody"
    assert GeometricConsistency(priors="weigh").needs_prior and not TRUST.needs_prior
    assert TSDF(trust=GeometricConsistency(priors="weigh")).needs_prior and not TSDF(trust=TRUST).needs_prior


def test_weights_are_multiplied_and_nothing_else():
    shade = np.array([[32 << 24 | 0xABCDEF, 1 << 24 | 5, 7, 200 << 24]], np.uint32)
    found = weighed(shade, np.array([[0.5, 0.2, 1.0, 2.0]], np.float32))
    assert (found >> 24).tolist() == [[16, 1, 0, 255]] and (found & 0xFFFFFF).tolist() == [[0xABCDEF, 5, 7, 0]]
    assert (weighed(shade, np.zeros((1, 4), np.float32)) >> 24 == 0).all()


def noisy(cameras):
    """What the views of a sphere see, with errors that differ from view to view."""
    given, draw, maps = subject(cameras, sphere), np.random.default_rng(3), {}
    for at, camera in enumerate(cameras):
        exact = maps_of(camera, sphere)
        off = torch.ones(72, 96)
        y, x = draw.integers(10, 50, 2)
        off[y : y + 12, x : x + 12] = 0.8
        maps[f"{at}"] = replace(exact, median=exact.median * off, depth=exact.depth * off)
    return replace(given, draw=lambda view: maps[view.name])


def test_tiles_threads_and_numpy_give_the_same_bits(monkeypatch, tmp_path):
    mesher = TSDF(voxel=0.4, trust=GeometricConsistency(angle=25.0))
    given = replace(noisy(around(24)), scratch=tmp_path)
    whole = mesher.mesh(given)
    assert np.abs(sphere(whole.vertices)).max() < 0.04 and not list(tmp_path.iterdir())
    before = torch.get_num_threads()
    torch.set_num_threads(2 if before == 1 else 1)
    try:
        other = mesher.mesh(given)
    finally:
        torch.set_num_threads(before)
    assert np.array_equal(whole.vertices, other.vertices) and np.array_equal(whole.colors, other.colors)
    if native.module() is not None:
        few = replace(noisy(around(5)), scratch=tmp_path)
        coarse = replace(mesher, voxel=0.6, least_views=0.2)
        compiled = coarse.mesh(few)
        monkeypatch.setattr(native, "module", lambda: None)
        with_numpy = coarse.mesh(few)
        monkeypatch.undo()
        assert np.array_equal(compiled.vertices, with_numpy.vertices)
        assert np.array_equal(compiled.faces, with_numpy.faces) and np.array_equal(compiled.colors, with_numpy.colors)
    monkeypatch.setattr(tsdf, "plan", lambda found, most: cut_in_eight())
    tiled = mesher.mesh(given)
    assert tiled.facts["tiles"] == 8 and np.array_equal(faces_by_place(whole), faces_by_place(tiled))


def test_every_view_is_drawn_once(tmp_path):
    given, drawn = noisy(around(20)), []

    def draw(view: View) -> Maps:
        drawn.append(view.name)
        return given.draw(view)

    TSDF(voxel=0.4, truncation=1.6, depth_limit=50.0, trust=TRUST).mesh(replace(given, draw=draw, scratch=tmp_path))
    assert sorted(drawn) == sorted(view.name for view in given.views)


def test_settings_that_cannot_be_are_refused():
    for wrong in (
        {"tolerance": 0.0}, {"angle": 50.0}, {"alone": 1.5}, {"opaque": -0.1}, {"spread": 2.0}, {"confirmed": 0.5},
        {"neighbours": 0}, {"enough": 0.0}, {"enough": float("inf")}, {"covered_by": -1},
    ):  # fmt: skip
        with pytest.raises(BadInput, match=f"{next(iter(wrong))} .*(must be|give)"):
            GeometricConsistency(**wrong)
