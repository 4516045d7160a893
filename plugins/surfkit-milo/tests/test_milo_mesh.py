"""The mesh between pivots: vertices, its depth and normals with their gradients, and the fused depth at pivots."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from surfkit_milo.loop import COUNT, SUM, MeshInTheLoop
from surfkit_milo.mesh_maps import draw_mesh
from surfkit_milo.mesher import PivotMesh
from surfkit_milo.pivots import PIVOTS, Boxes, crossings, tetrahedra, vertices

from surfkit.mesh.poisson import require_open3d
from surfkit.plugin import BadInput, Camera, Maps, MeshInput, RegularizerInput, Splats, Target
from surfkit.testing.inputs import BALL_RADIUS, above, mesh_input

NORMAL = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64) / 1.05**0.5
"""Of the plane NORMAL . x = 0.02."""


def boxes(count: int = 300) -> Boxes:
    """Boxes in a slab, whose pivots have their distances from a plane as values."""
    draw = torch.Generator().manual_seed(0)
    centres = (torch.rand(count, 3, generator=draw, dtype=torch.float64) - 0.5) * torch.tensor([1.0, 1.0, 0.2])
    quats = torch.randn(count, 4, generator=draw, dtype=torch.float64)
    half = 0.02 + 0.05 * torch.rand(count, 3, generator=draw, dtype=torch.float64)
    made = Boxes(centres, quats, half, torch.zeros(count, PIVOTS, dtype=torch.float64))
    values = made.places() @ NORMAL - 0.02
    return replace(made, occupancies=values / made.sizes[:, None])


def surface(of: Boxes) -> np.ndarray:
    return crossings(tetrahedra(of.places().view(-1, 3)), of, 0.0)


def pivot_splats(subject: MeshInput) -> Splats:
    """The ball of Gaussians, all of them with pivots without a value."""
    count = len(subject.splats)
    extra = {"occupancies": torch.zeros(count, PIVOTS), "spread": torch.ones(count)}
    return replace(subject.splats, extra=extra)


def test_vertices_of_a_linear_field_lie_on_its_plane():
    given = boxes()
    ends = torch.from_numpy(surface(given))
    found = vertices(given, ends.view(-1, 2))
    assert len(ends) > 500
    assert (found @ NORMAL - 0.02).abs().max() < 1e-12
    a, b, c = found.view(-1, 3, 3).unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    across = across[across.norm(dim=1) > 1e-9]
    assert ((across @ NORMAL) > 0).all(), "the outer side is where the field is above 0"


def test_vertices_have_the_gradients_of_finite_differences():
    given = boxes(40)
    ends = torch.from_numpy(surface(given)).view(-1, 2)[:60]

    def found(centres, quats, occupancies):
        return vertices(replace(given, centres=centres, quats=quats, occupancies=occupancies), ends)

    leaves = [each.clone().requires_grad_() for each in (given.centres, given.quats, given.occupancies)]
    assert torch.autograd.gradcheck(found, leaves, atol=1e-6)
    assert torch.autograd.gradcheck(lambda half: replace(given, half=half).places(), given.half.requires_grad_())


def test_long_edges_have_no_triangles():
    given = boxes()
    tets = tetrahedra(given.places().view(-1, 3))
    few, all_of_them = crossings(tets, given, 0.6), crossings(tets, given, 0.0)
    assert 0 < len(few) < len(all_of_them)
    places = given.places().view(-1, 3)
    length = (places[few[..., 0]] - places[few[..., 1]]).norm(dim=-1)
    assert (length <= 0.6 * given.sizes[torch.from_numpy(few) // PIVOTS].sum(-1)).all()


def test_depth_and_normals_are_those_of_the_plane_and_of_a_ray_caster():
    try:
        o3d = require_open3d("this test")
    except BadInput as error:
        pytest.skip(str(error))
    given, camera = boxes(), above(0.05, -0.1)
    bent = replace(given, occupancies=given.occupancies + 0.3 * torch.sin(40 * given.places()[..., 0]))
    pose, rays = camera.world_to_camera, camera.rays(torch.float64)
    for case in (given, bent):
        ends = surface(case)
        found = draw_mesh(case, ends, camera)
        corners = vertices(case, torch.from_numpy(ends).view(-1, 2)).numpy()
        scene = o3d.t.geometry.RaycastingScene()
        faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        scene.add_triangles(o3d.core.Tensor(corners.astype(np.float32)), o3d.core.Tensor(faces))
        ways = rays.flatten(1).T @ pose[:3, :3]
        cast = torch.cat([camera.centre.expand_as(ways), ways], 1).float().numpy()
        hits = scene.cast_rays(o3d.core.Tensor(cast))
        depth = torch.from_numpy(hits["t_hit"].numpy())[found.pixels].double()  # rays have z = 1
        normal = torch.from_numpy(hits["primitive_normals"].numpy())[found.pixels].double() @ pose[:3, :3].T
        near = (depth - found.depth).abs() < 1e-5
        assert len(found.pixels) > 1_000 and near.float().mean() > 0.999, "but for pixels on an edge"
        assert ((normal * found.normal).sum(1).abs()[near] > 1 - 1e-4).float().mean() > 0.999
        assert ((found.normal * rays.flatten(1).T[found.pixels]).sum(1) < 0).all()
    plain = draw_mesh(given, surface(given), camera)
    way = rays.flatten(1).T[plain.pixels] @ pose[:3, :3]
    assert torch.allclose(plain.depth, (0.02 - camera.centre @ NORMAL) / (way @ NORMAL), atol=1e-9)
    assert torch.allclose(plain.normal, (pose[:3, :3] @ NORMAL).expand_as(plain.normal), atol=1e-6)


def test_depth_has_the_gradient_of_finite_differences_within_triangles():
    given, camera = boxes(), above(0.0, 0.0)
    ends, draw = surface(given), torch.Generator().manual_seed(3)
    leaves = [each.clone().requires_grad_() for each in (given.centres, given.quats, given.half, given.occupancies)]
    shown = draw_mesh(Boxes(*leaves), ends, camera)
    ways = [torch.randn(leaf.shape, generator=draw, dtype=torch.float64) for leaf in leaves]
    ways[2] = 0 * ways[2]  # half sides are also the unit of values, which is constant
    step = 1e-7
    moved = [draw_mesh(Boxes(*(x.detach() + s * w for x, w in zip(leaves, ways, strict=True))), ends, camera)
             for s in (-step, step)]  # fmt: skip
    same = [torch.isin(shown.pixels, each.pixels) for each in moved]
    assert all(each.all() for each in same) and len(moved[0].pixels) == len(moved[1].pixels) == len(shown.pixels)
    for at in range(0, len(shown.pixels), 97):
        slopes = torch.autograd.grad(shown.depth[at], leaves, retain_graph=True)
        slope = sum((s * w).sum() for s, w in zip(slopes, ways, strict=True))
        assert float((moved[1].depth - moved[0].depth)[at]) / (2 * step) == pytest.approx(float(slope), abs=1e-4)


def flat(z: float, camera: Camera) -> Maps:
    """What a plane at a height looks like from above."""
    size = camera.height, camera.width
    depth = torch.full(size, float(camera.centre[2]) - z)
    normal = torch.tensor([0.0, 0.0, -1.0])[:, None, None].expand(3, *size).contiguous()
    return Maps(color=torch.zeros(3, *size), alpha=torch.ones(size), depth=depth, median=depth.clone(), normal=normal)


def given_step(maps: Maps, view, columns: dict, index: int, count: int) -> RegularizerInput:
    def stat(name: str, *shape: int) -> torch.Tensor:
        return columns.setdefault(name, torch.zeros(count, *shape))

    seen = torch.ones(count, dtype=torch.bool)
    return RegularizerInput(index, 100, Target(view, maps.need("color")), maps, seen, stat)


def layer(z: float, count: int = 400) -> Splats:
    """Flat Gaussians with pivots around a height, whose values put the mesh there."""
    draw = torch.Generator().manual_seed(0)
    means = torch.cat([torch.rand(count, 2, generator=draw) - 0.5, torch.full((count, 1), z)], 1)
    scales = torch.tensor([0.03, 0.03, 0.01]).expand(count, 3).contiguous()
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous()
    blank = {"occupancies": torch.zeros(count, PIVOTS), "spread": torch.ones(count)}
    made = Splats("gaussian", means, quats, scales, torch.full((count,), 0.9), torch.zeros(count, 1, 3), extra=blank)
    around = Boxes.of(made, torch.ones(count))
    return replace(made, extra=blank | {"occupancies": (around.places()[..., 2] - z) / around.sizes[:, None]})


def test_the_depth_loss_pulls_the_mesh_to_the_splats_and_the_splats_to_the_mesh():
    term = MeshInTheLoop(watch=0, start=1, until=100, refresh=1)
    view, columns = mesh_input().views[0], {}
    view = replace(view, camera=above(0.0, 0.0))
    splats, maps = layer(0.0), flat(0.01, view.camera)  # what is drawn lies 1 cm above the mesh
    count = len(splats)
    term.triangulate(splats, given_step(maps, view, columns, 1, count))
    leaves = {"means": splats.means.clone(), "occupancies": splats.extra["occupancies"].clone()}
    leaves = {name: value.requires_grad_() for name, value in leaves.items()}
    now = replace(splats, means=leaves["means"], extra=dict(splats.extra) | {"occupancies": leaves["occupancies"]})
    depth = maps.need("median").clone().requires_grad_()
    value = term.with_maps(now, given_step(replace(maps, median=depth), view, columns, 2, count))
    assert float(value.detach()) == pytest.approx(0.05 * np.log1p(0.01), rel=2e-2)
    by_depth, by_means, by_values = torch.autograd.grad(value, [depth, *leaves.values()])
    assert (by_depth <= 0).all() and (by_depth < 0).float().mean() > 0.9, "splats that are too near move away"
    assert float(by_means[:, 2].sum()) < 0, "the mesh, which is too low, is to rise with its Gaussians"
    assert float(by_values.sum()) > 0, "or by more of its pivots inside"

    optimiser = torch.optim.Adam([leaves["occupancies"]], lr=0.005)
    for index in range(2, 62):
        optimiser.zero_grad()
        loss = term.with_maps(now, given_step(maps, view, columns, index, count))
        loss.backward()
        optimiser.step()
    assert float(loss.detach()) < 0.3 * float(value.detach())


def test_only_pixels_that_count_have_a_gradient():
    term, view, columns = MeshInTheLoop(watch=0, start=1, until=100), mesh_input().views[0], {}
    view = replace(view, camera=above(0.0, 0.0))
    splats, maps = layer(0.0), flat(0.01, view.camera)
    step = given_step(maps, view, columns, 1, len(splats))
    term.triangulate(splats, step)
    keep = torch.arange(view.camera.width) < 20
    depth = maps.need("median").clone().requires_grad_()
    step = replace(step, index=2, maps=replace(maps, median=depth))
    step = replace(step, target=replace(step.target, mask=keep.expand(view.camera.height, -1)))
    (slope,) = torch.autograd.grad(term.with_maps(splats, step), depth)
    assert slope[:, :20].any() and not slope[:, 20:].any()


def exact(camera: Camera) -> Maps:
    """The depth of the ball itself."""
    ways = torch.einsum("ij,jhw->ihw", camera.world_to_camera[:3, :3].T, camera.rays(torch.float64))
    a, b = ways.square().sum(0), (ways * camera.centre[:, None, None]).sum(0)
    root = b * b - a * (camera.centre.square().sum() - BALL_RADIUS**2)
    depth = torch.where(root > 0, (-b - root.clamp_min(0).sqrt()) / a, 0.0).float()
    return Maps(color=torch.zeros(3, *depth.shape), alpha=(depth > 0).float(), depth=depth, median=depth)


@pytest.fixture(scope="module")
def ball():
    """The ball of Gaussians with pivots, and the columns after exact depth maps of all views are fused."""
    subject = mesh_input("gaussian", count=900, views=14)
    term, columns, splats = MeshInTheLoop(watch=0, start=100, until=200), {}, pivot_splats(subject)
    for index, view in enumerate(subject.views, 1):
        term.fuse(splats, given_step(exact(view.camera), view, columns, index, len(splats)))
    return subject, splats, columns


def test_fused_depth_tells_the_inside_of_a_ball_from_its_outside(ball):
    _, splats, columns = ball
    height = Boxes.of(splats, torch.ones(len(splats))).places().norm(dim=2) - BALL_RADIUS
    seen, mean = columns[COUNT] > 0, columns[SUM] / columns[COUNT].clamp_min(1)
    clear = seen & (height.abs() > 0.004)
    assert clear.float().mean() > 0.5
    assert ((mean > 0) == (height > 0))[clear].float().mean() > 0.97


def test_the_mesh_of_a_ball_of_fused_depth_is_the_ball(ball):
    subject, splats, columns = ball
    around = Boxes.of(splats, torch.ones(len(splats)))
    begun = columns[SUM] / columns[COUNT].clamp_min(1e-9) / around.sizes[:, None]
    begun, known = torch.where(columns[COUNT] > 0, begun, -0.1), columns[COUNT][:, 0] > 0
    extra = {"occupancies": torch.where(begun == 0, 1e-6, begun), "spread": known.float()}
    mesh = PivotMesh().mesh(replace(subject, splats=replace(splats, extra=extra)))
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert len(mesh.faces) > 1_000 and mesh.facts["gaussians_with_pivots"] == int(known.sum())
    assert np.median(np.abs(radius - BALL_RADIUS)) < 0.005 * BALL_RADIUS
    assert (mesh.colors[:, 0] > 200).mean() > 0.9 and mesh.colors[:, 1].mean() < 60


def test_a_mesh_without_pivots_is_refused(ball):
    subject, splats, _ = ball
    with pytest.raises(BadInput, match="primitive:pivoted"):
        PivotMesh().mesh(subject)
    with pytest.raises(BadInput, match="no surface between"):
        PivotMesh().mesh(replace(subject, splats=splats))
