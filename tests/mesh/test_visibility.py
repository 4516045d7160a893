"""The surface between what views see through and what they do not, where it is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from listening import listening
from needs import needs_native

from surfkit.core.check import BadInput
from surfkit.core.events import Progress
from surfkit.mesh.base import Mesh
from surfkit.mesh.closed import open_or_crowded
from surfkit.mesh.delaunay import tetrahedralised
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.manifold import separated
from surfkit.mesh.refine_vertices import adjusted, face_normals
from surfkit.mesh.surface_points import boxes_with, gather, merged
from surfkit.mesh.view_observations import ObservationSettings, ViewObservation
from surfkit.mesh.view_observations import seen as seen_by_all
from surfkit.mesh.visibility import OUTWARD, Visibility
from surfkit.raster.native import module
from surfkit.testing import check_mesher

from .shapes import around, look_at, slope, sphere, subject, torus

pytestmark = needs_native

PLAIN = Visibility(cell_px=1.5, least_weight=0.1, flat=0.0, sky=True)
CAMERAS = around(14)


@pytest.fixture(scope="module")
def ring():
    """A torus, seen from all around."""
    return PLAIN.mesh(subject(CAMERAS, torus))


def boundary_share(mesh):
    a, b = mesh.faces, np.roll(mesh.faces, -1, 1)
    _, counts = np.unique(np.sort(np.stack([a, b], -1).reshape(-1, 2), axis=1), axis=0, return_counts=True)
    return (counts == 1).mean(), int((counts > 2).sum())


def test_a_torus_is_a_closed_torus(ring):
    assert open_or_crowded(ring) == 0
    edges = len(ring.faces) * 3 // 2
    assert len(np.unique(ring.faces)) - edges + len(ring.faces) == 0, "the number of Euler of a torus"
    pixel = 2.0 / 90
    off = np.abs(torus(ring.vertices.astype(float)))
    assert np.median(off) < 0.1 * pixel and np.quantile(off, 0.99) < 0.7 * pixel
    a, b, c = ring.vertices[ring.faces].astype(float).transpose(1, 0, 2)
    volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(2 * np.pi**2 * 0.5 * 0.2**2, rel=0.02), "it faces outwards"
    assert np.abs(ring.colors.astype(int) - [204, 102, 51]).max() <= 2


def test_vertices_know_who_confirms_them(ring):
    views, error = ring.values["views"], ring.values["error"]
    assert np.median(views) >= 3 and views.max() <= len(CAMERAS)
    pixel = 2.0 / 90
    assert np.isnan(error[views == 0]).all() and np.nanmedian(error) < 0.2 * pixel


def test_open_ground_is_open_at_its_rim_only():
    cameras = [look_at((x, y, 2.0), (x, y, 0)) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)]
    mesh = PLAIN.mesh(subject(cameras, slope))
    share, crowded = boundary_share(mesh)
    assert crowded == 0 and 0 < share < 0.2
    inner = np.abs(mesh.vertices[:, :2]).max(1) < 0.6
    free = np.zeros(len(mesh.vertices), bool)
    free[rim(mesh)] = True
    assert inner.sum() > 50 and not (inner & free).any(), "without a hole"
    assert np.abs(slope(mesh.vertices.astype(float))).max() < 0.01
    assert (face_normals(mesh.vertices, mesh.faces)[0][:, 2] > 0).all()


def rim(mesh):
    a, b = mesh.faces, np.roll(mesh.faces, -1, 1)
    sides, counts = np.unique(np.sort(np.stack([a, b], -1).reshape(-1, 2), axis=1), axis=0, return_counts=True)
    return sides[counts == 1]


def test_planes_have_few_points():
    cameras = [look_at((x, y, 2.0), (x, y, 0)) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)]
    given = subject(cameras, slope)
    few, all_ = (replace(PLAIN, flat=flat).mesh(given) for flat in (0.25, 0.0))
    assert few.facts["points"] < all_.facts["points"] / 8


def test_what_lies_on_an_edge_stays():
    """Of a roof of two planes, the points near the ridge do not become one."""
    x, y = np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5)
    z = 12 - np.abs(x - 8) + 0.0
    places = np.stack([x, y, z], -1).reshape(-1, 3)
    side = np.sign(places[:, :1] - 8)
    normals = np.concatenate([side, 0 * side, np.abs(side)], 1) / np.sqrt(2)
    sums = np.concatenate([np.ones((256, 1)), places, normals, 0 * places, np.ones((256, 1))], 1)
    cell = np.floor(places).astype(int)
    kept_cell, kept = merged((cell + 1) >> 1, sums, 0.25)  # shifted, so that cells cross the ridge
    assert kept[:, 10].sum() == 256
    kept = kept[:, 1:4] / kept[:, :1]
    near = np.abs(places[:, 0] - 8) < 1
    ridge = {tuple(row) for row in places[near]}
    assert ridge <= {tuple(row) for row in kept} and len(kept) < len(places) / 2 and len(kept_cell) == len(kept)
    assert np.allclose(kept[:, 2], 12 - np.abs(kept[:, 0] - 8))


def test_a_wall_that_no_depth_confirms_is_closed_up_to_a_width():
    """A hole in all depth maps, about ten cells wide."""
    cameras = [look_at((x, y, 2.0), (x, y, 0)) for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)]
    given = subject(cameras, slope)

    def holed(view):
        maps = given.draw(view)
        pose = view.camera.world_to_camera.numpy()
        local = view.camera.rays(torch.float64).numpy() * maps.depth.numpy()
        place = np.einsum("ji,jhw->ihw", pose[:3, :3], local - pose[:3, 3][:, None, None])
        there = torch.from_numpy(np.hypot(place[0], place[1]) > 0.15)
        return replace(maps, alpha=maps.alpha * there, depth=maps.depth * there, median=maps.median * there)

    for guesses, closes in ((14.0, True), (5.0, False)):
        mesh = replace(PLAIN, guesses=guesses).mesh(replace(given, draw=holed))
        near = np.hypot(*mesh.vertices[:, :2].T) < 0.2
        free = np.zeros(len(mesh.vertices), bool)
        free[rim(mesh)] = True
        assert (near & free).any() != closes


def test_thin_walls_have_two_sides():
    def wall(points):
        return np.abs(points @ np.array([0.6, 0.0, 0.8])) - 0.05

    def plate(points):
        return np.maximum(wall(points), np.linalg.norm(points, axis=-1) - 0.6)

    mesh = PLAIN.mesh(subject(around(20), plate))
    across = mesh.vertices.astype(float) @ np.array([0.6, 0.0, 0.8])
    inner = np.linalg.norm(mesh.vertices, axis=1) < 0.5
    assert (across[inner] > 0.03).sum() > 100 and (across[inner] < -0.03).sum() > 100
    assert np.abs(np.abs(across[inner]) - 0.05).max() < 0.02


def test_it_keeps_the_contract_of_meshers():
    check_mesher(Visibility(least_weight=0.1, sky=True))


def test_the_number_of_threads_changes_nothing(ring):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if before > 1 else 2)
        again = PLAIN.mesh(subject(CAMERAS, torus))
    finally:
        torch.set_num_threads(before)
    assert np.array_equal(again.vertices, ring.vertices) and np.array_equal(again.faces, ring.faces)


def meshed_with(given, monkeypatch, halo):
    """The mesh, and what was done for it."""
    monkeypatch.setattr("surfkit.mesh.visibility.HALO", halo)
    with listening(Progress, lambda event: event.what) as done:
        return PLAIN.mesh(given), done


def test_tiles_meet(ring, monkeypatch, warned):
    """With little memory the torus is cut in tiles: it is as good, and closed but for a crack or two."""
    mesh, done = meshed_with(subject(CAMERAS, torus, budget_bytes=8_000_000), monkeypatch, halo=10.0)
    assert "voting, tile 4 of 4" in done and not warned
    share, crowded = boundary_share(mesh)
    assert share < 0.0005 and crowded == 0
    assert len(mesh.faces) == pytest.approx(len(ring.faces), rel=0.01)
    off = np.abs(torus(mesh.vertices.astype(float)))
    assert np.quantile(off, 0.99) < 0.7 * 2.0 / 90


def test_tiles_that_know_nothing_of_each_other_do_not_meet(monkeypatch):
    """What the test before measures: without what is decided, it is another surface in each tile."""
    monkeypatch.setattr(
        "surfkit.mesh.cut_tiles.DecidedTetrahedra.of", lambda self, tile, corners: np.full(len(corners), -1)
    )
    mesh, _ = meshed_with(subject(CAMERAS, torus, budget_bytes=8_000_000), monkeypatch, halo=10.0)
    assert boundary_share(mesh)[0] > 0.0005


def test_points_are_the_same_however_many_boxes_they_are_gathered_in():
    how = ObservationSettings("median", 10.0, GeometricConsistency(), 0.05, 0.0, 0.25)
    with seen_by_all(subject(CAMERAS, torus), how) as sights:
        assert len(boxes_with(sights, 0.03, 10.0, 2_000)) >= 4
        whole, parts = (gather(sights, 0.03, 10.0, 0.1, 0.05, most) for most in (10**9, 2_000))
    assert len(whole.places) > 200
    for name in ("places", "normals", "colors", "cells"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))


def test_too_little_memory_is_told(monkeypatch, warned):
    mesh, _ = meshed_with(subject(CAMERAS, torus, budget_bytes=1_000_000), monkeypatch, halo=100.0)
    assert open_or_crowded(mesh) == 0
    assert [text for text in warned if "one tile needs about" in text]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"cell_px": 0.0}, "mesh.cell_px is 0; .*0.1 to 100"),
        ({"area": -1.0}, "mesh.area is -1; .*0.001 to 1000"),
        ({"cell": -1.0}, "mesh.cell"),
    ],
)
def test_settings_that_are_refused(change, said):
    with pytest.raises(BadInput, match=said):
        replace(PLAIN, **change)


def test_cells_that_cannot_be_numbered_are_refused():
    with pytest.raises(BadInput, match="mesh.cell is 1e-06 m, .* m; give"):
        replace(PLAIN, cell=1e-6).mesh(subject(CAMERAS, sphere))


def test_what_a_view_itself_trusts_less_weighs_less():
    """The spread of the splats along the ray halves the weight at its value, as when depth maps are fused."""
    given = subject(CAMERAS, sphere)

    def spread(view):
        maps = given.draw(view)
        return replace(maps, depth=1.01 * maps.depth)

    weights = []
    for trust in (GeometricConsistency(), GeometricConsistency(spread=0.01)):
        with seen_by_all(
            replace(given, draw=spread), ObservationSettings("median", 10.0, trust, 0.05, 0.0, 0.25)
        ) as sights:
            weights.append(sights[0].weight[0])
    there = weights[0] > 0
    assert there.sum() > 100 and np.allclose(weights[1][there] / weights[0][there], 0.5, atol=0.01)


def test_nothing_to_mesh():
    with pytest.raises(BadInput, match="nothing to mesh"):
        PLAIN.mesh(replace(subject(CAMERAS, torus), views=[]))
    with pytest.raises(BadInput, match="least-weight 1000"):
        replace(PLAIN, least_weight=1000).mesh(subject(CAMERAS, sphere))


def sight(depth, weight, normal=(0.0, 0.0, -1.0)):
    camera = look_at((0, 0, -2.0), (0, 0, 0), focal=20.0, size=(16, 12))
    shape = (1, 12, 16)
    normals = np.broadcast_to(np.array(normal, np.float32)[:, None, None], (3, 12, 16)).copy()
    color = np.zeros((3, 12, 16), np.uint8)
    return ViewObservation(
        camera, np.full(shape, depth, np.float32), np.full(shape, weight, np.float32), normals, color
    )


def test_votes_by_the_distance_from_the_plane_of_a_pixel():
    """Against the sum, written out: sure from one deviation on, full for two, less for a surface seen at an angle."""
    view = sight(2.0, 0.5, (0.6, 0.0, -0.8))
    centre = view.camera.centre.numpy()
    forward = view.camera.world_to_camera[2, :3].numpy()
    depths = np.array([0.5, 1.9, 1.99, 2.0, 2.005, 2.02, 2.035, 2.05, 3.0, -1.0])
    places = (centre + depths[:, None] * forward).astype(np.float32)
    empty, full = np.zeros((2, len(depths)), np.float32)
    boxes = np.concatenate([places.min(0), places.max(0)])[None]
    module().vote(places, boxes, 0.01, 2.0, empty, full, *view.native, 1)
    column, row = view.camera.cx, view.camera.cy
    assert 0 <= column < 16 and 0 <= row < 12
    before = (2.0 - depths) * 0.8 / 0.02
    wanted = np.where(depths > 0, 0.5 * np.clip(before, 0, 1), 0)
    behind = 0.5 * np.minimum(np.minimum(-before, 1), 2 * (1 + before / 2))
    assert np.allclose(empty, wanted, atol=1e-4)
    assert np.allclose(full, np.where((before < 0) & (before > -2) & (depths > 0), behind, 0), atol=1e-4)


def test_pieces_out_of_sight_are_passed_over_and_no_others():
    view, random = sight(6.0, 0.5), np.random.default_rng(0)
    count = 20 * module().PIECE
    middles = np.repeat(random.normal(size=(20, 3)) * 3, module().PIECE, 0)
    places = (middles + 0.5 * random.normal(size=(count, 3))).astype(np.float32)
    firsts = np.arange(0, count, module().PIECE)
    near = np.concatenate([np.minimum.reduceat(places, firsts), np.maximum.reduceat(places, firsts)], 1)
    everywhere = np.tile(np.float32([-99] * 3 + [99] * 3), (20, 1))
    found = np.zeros((2, 2, count), np.float32)
    for boxes, votes in zip((near, everywhere), found, strict=True):
        module().vote(places, boxes, 0.01, 2.0, *votes, *view.native, 2)
    assert np.array_equal(found[0], found[1]) and (found[0, 0] > 0).sum() > 100
    behind = np.tile(np.float32([-1, -1, -9, 1, 1, -8]), (20, 1))
    none = np.zeros((2, count), np.float32)
    module().vote(places, behind, 0.01, 2.0, *none, *view.native, 2)
    assert not none.any(), "the camera stands at -2, and looks along z"


def test_places_are_found():
    random = np.random.default_rng(0)
    tets = tetrahedralised(random.random((500, 3)))
    asked = 0.2 + 0.6 * random.random((200, 3))
    found = np.empty(200, np.int32)
    start = random.integers(0, len(tets.corners), 200).astype(np.int32)
    module().locate(tets.points, tets.corners, tets.neighbours, asked, start, found, 2)
    corners = tets.points[tets.corners[found]]
    shares = np.linalg.solve(
        np.concatenate([corners.transpose(0, 2, 1), np.ones((200, 1, 4))], 1),
        np.concatenate([asked, np.ones((200, 1))], 1)[..., None],
    )
    assert shares.min() > -1e-9


def test_the_cost_of_faces():
    """Area in cells; less where many votes are, and where it lies as the normals say; the same from both sides."""
    random = np.random.default_rng(0)
    tets = tetrahedralised(random.random((60, 3)))
    normals = random.normal(size=(60, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(tets.corners)
    votes = random.random(count).astype(np.float32)
    cost = np.empty((count, 4), np.int32)
    given = tets.points, tets.corners, tets.neighbours, normals, votes
    module().price(*given, 0.1, 0.3, 0.2, 0.5, cost, 1)
    for tet in range(count):
        for i in range(4):
            face, other = np.delete(tets.corners[tet], i), tets.neighbours[tet, i]
            real = face[face < 60]
            if other < 0 or len(real) < 2:
                assert cost[tet, i] == 0
                continue
            if len(real) == 2:  # a strip of a cell along the rim
                rim = np.linalg.norm(tets.points[real[0]] - tets.points[real[1]])
                assert cost[tet, i] == pytest.approx(1000 * rim / 0.1, abs=1)
                continue
            a, b, c = tets.points[face]
            across = np.cross(b - a, c - a)
            size = np.linalg.norm(across)
            turned = 1 - abs(across @ normals[face].mean(0)) / size
            share = (0.3 + 0.7 * turned) * (0.2 + 0.8 / (1 + (votes[tet] + votes[other]) / 2 / 0.5))
            assert cost[tet, i] == pytest.approx(1000 * size / 2 / 0.01 * share, abs=1)
            assert cost[tet, i] in cost[other]


def test_bodies_that_touch_along_an_edge_come_apart():
    """Two cubes in a ring that meets itself: no edge has more than two triangles, and nothing is lost."""
    cube = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5],
                     [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])  # fmt: skip
    box = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1.0]])
    places, faces = np.concatenate([box, box + [1, 1, 0]]), np.concatenate([cube, cube + 8])
    _, first, one = np.unique(places, axis=0, return_index=True, return_inverse=True)
    mesh = Mesh(places[first].astype(np.float32), one.ravel()[faces].astype(np.int32))
    assert boundary_share(mesh) == (0, 1)
    apart = separated(mesh)
    assert boundary_share(apart) == (0, 0) and len(apart.vertices) == 16


@pytest.mark.parametrize("seed", range(3))
def test_bodies_that_touch_in_every_way_come_apart(seed):
    """Every second tetrahedron of many is full, at random: sheets have edges, and both of their ends, in common."""
    random = np.random.default_rng(seed)
    tets = tetrahedralised(random.random((60, 3)))
    full = (random.random(len(tets.corners)) < 0.5) & (tets.corners < 60).all(1)
    rows, corner = np.nonzero(full[:, None] & (tets.neighbours >= 0) & ~full[tets.neighbours])
    faces = np.take_along_axis(tets.corners[rows], OUTWARD[corner], 1)
    mesh = Mesh(tets.points.astype(np.float32), faces)
    assert boundary_share(mesh)[1] > 50
    assert boundary_share(separated(mesh)) == (0, 0)


class Exact:
    """Sights of a shape, in memory."""

    def __init__(self, given):
        self.found = []
        for view in given.views:
            maps = given.draw(view)
            depth = maps.depth[None].numpy()
            color = np.zeros((3, *depth.shape[1:]), np.uint8)
            weight = (depth > 0).astype(np.float32)
            self.found.append(ViewObservation(view.camera, depth, weight, maps.normal.numpy(), color))

    def __len__(self):
        return len(self.found)

    def __getitem__(self, at):
        return self.found[at]


def test_noisy_vertices_are_moved_to_what_views_see(ring):
    noisy = replace(ring, vertices=ring.vertices + np.random.default_rng(0).normal(0, 0.006, ring.vertices.shape))
    moved = adjusted(Exact(subject(CAMERAS, torus)), noisy, 0.05, 100.0, 0.3)
    before, after = (np.abs(torus(mesh.vertices.astype(float))) for mesh in (noisy, moved))
    assert np.median(after) < 0.25 * np.median(before)
    assert moved.values["views"].shape == (len(moved.vertices),) and np.nanmedian(moved.values["error"]) < 0.002
