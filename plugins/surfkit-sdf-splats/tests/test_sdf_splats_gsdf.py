"""GSDF against planes: where rays are sampled, where splats grow and fade, when both branches agree."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import surfkit_sdf_splats.gsdf as gsdf
import torch
from surfkit_neus.box import scene_box
from surfkit_neus.field import Networks
from surfkit_neus.hashgrid import Grid
from surfkit_neus.render import Samples
from surfkit_octree.anchors import Anchors
from surfkit_octree.growth import OPACITY, VIEWS, AnchorGrowth
from surfkit_sdf_splats.branches import Surface
from surfkit_sdf_splats.density import NearSurface, nearness
from surfkit_sdf_splats.gsdf import GSDF, SharedPixels, field_shape, guided_range, mutual, splat_shape

from surfkit.plugin import ADC, BadInput, Camera, Derived, Frame, Maps, Points, Scene, SparsePoints, Stage, Target, View
from surfkit.testing.inputs import crowd

LEVEL = 0.5
SMALL = dict(
    grid=Grid(levels=4, table_bits=10, coarsest=8, finest=32),
    background=Grid(levels=2, table_bits=8, coarsest=4, finest=8),
    networks=Networks(width=16, features=7),
    first_level=4,
    photos=1,
)


def above(tilt=0.4) -> Camera:
    """A camera 2 above the ground z = 0, that looks down and aside."""
    c, s = np.cos(tilt), np.sin(tilt)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[1, 0, 0], [0, -c, -s], [0, s, -c]], dtype=torch.float64)
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([0.1, -0.8, 2.0], dtype=torch.float64)
    return Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24)


def ground(z: float = 0.0) -> tuple[Target, Maps]:
    """A photograph of the plane of this height, and the exact maps of it."""
    camera = above()
    rays = torch.einsum("ij,jhw->ihw", camera.world_to_camera[:3, :3].T, camera.rays(torch.float64))
    depth = ((z - camera.centre[2]) / rays[2]).float()
    normal = camera.world_to_camera[:3, 2].float()[:, None, None].expand(3, 24, 32)
    alpha = torch.full((24, 32), 0.8)
    maps = Maps(color=torch.zeros(3, 24, 32), alpha=alpha, depth=alpha * depth, normal=alpha * normal)
    return Target(View("a", camera, Path("a")), torch.rand(3, 24, 32)), maps


def link(samples=Samples(8, 6, 1, 4), **settings) -> SharedPixels:
    """Both branches, before the first step: the distance is that of the plane of the sparse points, z = 0."""
    camera = above()
    xyz = torch.rand(400, 3, generator=torch.Generator().manual_seed(2)) * torch.tensor([4.0, 3.0, 0.0]) - 1.5
    xyz[:, 2] = 0
    view = View("a", camera, Path("a"))
    scene = Scene("a", (view,), (), SparsePoints(xyz, torch.zeros(400, 3, dtype=torch.uint8)), Frame(np.zeros(3), 1.0))
    surface = replace(GSDF().surface, **SMALL, samples=samples, rays=200, steps=40, sharpness=500.0)
    box = scene_box(scene, 0.1)
    assert box.shape == "plane"
    method = GSDF(splats=Stage(steps=40, densify=ADC()), surface=surface, **{"guided": 0} | settings)
    batches = SimpleNamespace(draw=lambda at: torch.Generator().manual_seed(at), points=torch.zeros(1, 3))
    state = surface.begin(box, 0, torch.device("cpu"))
    return SharedPixels(method, Surface(surface, state, box, batches, 0))


@pytest.mark.parametrize("off", [0.2, 0.05, 0.01])
def test_rays_are_sampled_around_the_depth_of_the_splats(off, monkeypatch):
    """Splats are `off` above the surface: |s| is that in units of the box, and rays are sampled k |s| around."""
    tie, seen = link(narrowest=1e-6), []
    monkeypatch.setattr(gsdf, "draw_along", lambda *given: seen.append(given))
    target, maps = ground(off)
    batch, pixels = tie.batch(target)
    turn = target.view.camera.world_to_camera[:3, :3] @ tie.surface.box.axes.T
    shape = splat_shape(maps, batch.rays, pixels, turn)
    tie.drawn(batch.rays, shape)
    rays, t = seen[0][2], seen[0][3]
    inside = (shape.t > rays.near) & (shape.t < rays.far)
    assert inside.float().mean() > 0.3 and t.shape == (200, 8), "as many as `even` says, and `surface` more later"
    half = 3 * off / tie.surface.box.scale
    away = (t - shape.t[:, None]).abs()[inside]
    assert (away <= half + 1e-5).all() and away.max() > 0.8 * half, "the interval is used, and shrinks with |s|"
    assert (t[~inside].amax(1) - t[~inside].amin(1) > 0.8 * (rays.far - rays.near)[~inside]).all(), "else, the box"


def test_the_number_of_samples_and_the_least_width(monkeypatch):
    tie = link(Samples(8, 6, 1, 4))
    target, maps = ground()
    batch, pixels = tie.batch(target)
    turn = target.view.camera.world_to_camera[:3, :3] @ tie.surface.box.axes.T
    shape = splat_shape(maps, batch.rays, pixels, turn)
    drawn = tie.drawn(batch.rays, shape)
    assert drawn.geometry.sdf.shape == (200 * (8 + 6 - 1),), "sections between 8 and 6 samples"
    near, far = guided_range(batch.rays, shape.t, torch.zeros(200), 3.0, 0.02)
    inside = (shape.t > batch.rays.near + 0.02) & (shape.t < batch.rays.far - 0.02)
    assert torch.allclose((far - near)[inside], torch.tensor(0.04), atol=1e-5)


def test_both_branches_agree_on_the_same_plane():
    target, maps = ground()
    tie = link(Samples(32, 32, 1, 4))
    batch, pixels = tie.batch(target)
    turn = target.view.camera.world_to_camera[:3, :3] @ tie.surface.box.axes.T
    splats = splat_shape(maps, batch.rays, pixels, turn)
    exact = (tie.surface.box.level - batch.rays.origin[:, 2]) / batch.rays.direction[:, 2]
    assert torch.allclose(splats.t, exact, atol=1e-4) and torch.allclose(
        splats.normal, torch.tensor([0.0, 0, 1]).expand(200, 3), atol=1e-5
    )
    assert all(abs(term) < 1e-6 for term in mutual(splats, splats, batch.weight))
    found = field_shape(tie.drawn(batch.rays, splats), batch.rays)
    depth, normal = mutual(splats, found, batch.weight)
    assert (splats.solid & found.solid).float().mean() > 0.3 and depth < 2e-3 and abs(normal) < 1e-5


def test_what_differs_pulls_both_branches_together():
    target, maps = ground(0.1)
    maps = replace(maps, depth=maps.depth.requires_grad_())
    tie = link(Samples(32, 32, 1, 4), guided=10)
    tie.look(maps, target).backward()
    rows = maps.depth.grad != 0
    assert rows.sum() > 50 and (maps.depth.grad[rows] < 0).all(), "splats above the surface are too near"
    assert {"depth", "normal", "color", "eikonal", "curvature"} <= set(tie.shared)
    tie.shared["depth"].backward()
    assert tie.surface.state.field.distance[-1].bias.grad[0] > 0, "the surface has to rise: f has to fall"
    masked = replace(target, mask=torch.zeros(24, 32, dtype=torch.bool))
    assert tie.look(maps, masked) == 0 and tie.shared["color"] == 0


def test_mutual_weights_fall_to_a_tenth_once():
    method = GSDF()
    assert method.mutual_at(15_000) == (0.01, 0.01) and method.mutual_at(15_001) == pytest.approx((1e-3, 1e-3))
    assert method.mutual_at(30_000) == pytest.approx((1e-3, 1e-3))


def plane(means):
    return means[:, 2] - LEVEL


def control(inner, **settings) -> NearSurface:
    return NearSurface(inner, plane, **{"sigma": 0.05, "grow": 1.5e-4, "prune": 0.01, "after": 100} | settings)


def test_mu_falls_with_the_distance():
    s = torch.tensor([0.0, 0.05, -0.05, 0.1, torch.inf])
    assert torch.allclose(nearness(s, 0.05), torch.tensor([1, np.exp(-0.5), np.exp(-0.5), np.exp(-2.0), 0.0]).float())


def test_splats_grow_near_the_surface_and_fade_away_from_it():
    points, step = crowd()
    splats = replace(step.splats, opacities=torch.full((200,), 0.008))
    step = replace(step, index=900, grad_norm=torch.full((200,), 1e-4) * step.seen, splats=splats)
    policy, near = control(ADC()), plane(splats.means).abs()
    policy.watch(points, step)
    edit = policy.edit(points, step)
    grown = edit.clone | edit.split
    mu = torch.exp(-near.square() / (2 * 0.05**2))
    assert torch.equal(grown, step.seen & (1e-4 + 1.5e-4 * mu >= 2e-4)) and grown.any(), "threshold 2e-4"
    assert torch.equal(edit.drop & ~grown, ~grown & (0.008 - 0.01 * (1 - mu) < 0.005))
    assert edit.drop[near > 0.1].all() and not edit.drop[near < 0.03].any()
    early = replace(step, index=90)
    plain = points.listed()
    plain.stats.clear()
    policy.watch(plain, early)
    assert torch.allclose(plain.stat("adc/grad"), early.grad_norm), "before its time, gradients are as they are"


def test_the_same_for_anchors():
    draw, count = torch.Generator().manual_seed(0), 60
    primitive = Anchors(offsets=2)
    xyz = torch.rand(count, 3, generator=draw)
    points = Points.fresh(
        primitive.init(SparsePoints(xyz, torch.zeros(count, 3, dtype=torch.uint8)), draw), primitive.shared()
    )
    step = crowd(count)[1]
    owner = torch.arange(count).repeat_interleave(2)
    made = replace(crowd(2 * count)[1].splats, means=xyz[owner], opacities=torch.full((2 * count,), 0.004))
    seen, signal = torch.ones(2 * count, dtype=torch.bool), torch.zeros(2 * count, 2)
    derived = Derived(made, owner, seen, signal, None, torch.full((2 * count,), 1e-4))
    splats = replace(step.splats, means=xyz)
    policy = control(AnchorGrowth(start=100, every=100, until=1000, shown=0.01))
    for index in (498, 499, 500):
        step = replace(step, index=index, derived=derived, splats=splats)
        policy.watch(points, step)
    mu = nearness(plane(xyz), 0.05)
    assert torch.allclose(points.stat("anchors/grad", 2), (3e-4 + 4.5e-4 * mu)[:, None].expand(count, 2))
    opacity = points.stats[OPACITY].clone()
    drop = policy.edit(points, step).drop
    assert torch.equal(drop, 0.008 - 0.01 * (1 - mu) < 0.005) and drop.any() and not drop.all()
    assert torch.equal(points.stats[OPACITY], opacity) and (points.stats[VIEWS] == 3).all(), "statistics stay"


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"reach": 0.0}, "reach"),
        ({"sigma": 0.0}, "sigma"),
        ({"grow": -1.0}, "grow"),
        ({"surface": replace(GSDF().surface, photos=4)}, "surface.photos"),
        ({"surface": replace(GSDF().surface, steps=50_000)}, "surface.steps"),
        ({"splats": Stage(steps=45_000, densify=None)}, "splats.densify"),
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong, said):
    with pytest.raises(BadInput, match=said):
        GSDF(**wrong)
