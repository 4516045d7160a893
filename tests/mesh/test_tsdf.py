"""The mesher: automatic lengths, metres, masks, tiles, and what it refuses."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from listening import listening
from needs import needs, needs_native

from surfkit.core.check import BadInput
from surfkit.core.events import Progress
from surfkit.mesh import fusion, tsdf
from surfkit.mesh import native_grid as native
from surfkit.mesh.fusion_image import depth_of, picture
from surfkit.mesh.fusion_lengths import MIN_TRUNCATION_VOXELS, without_hidden
from surfkit.mesh.grid_tiles import BlockRange, different
from surfkit.mesh.lattice import BLOCK_SIDE_VOXELS, Lattice, least_slant
from surfkit.mesh.reference_grid import ReferenceGrid, unpack
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Maps, Splats
from surfkit.scene.camera import Camera

from .shapes import around, look_at, maps_of, slope, sphere, subject, torus

trimesh = needs("trimesh")


def faces_by_place(mesh):
    """Triangles as sorted rows of coordinates and colours, each begun at its smallest corner."""
    corners = np.concatenate([mesh.vertices[mesh.faces], mesh.colors[mesh.faces]], axis=2)
    first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=1)[:, 0]
    turned = np.take_along_axis(corners, (first[:, None] + np.arange(3))[:, :, None] % 3, axis=1).reshape(-1, 18)
    return turned[np.lexsort(turned.T[::-1])]


@pytest.mark.parametrize("depth", ["median", "expected"])
@pytest.mark.parametrize("shape", [sphere, torus])
def test_a_solid_seen_from_all_sides(shape, depth):
    given = subject(around(24), shape)
    mesh = TSDF(voxel=0.4, depth=depth).mesh(given)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    solid.remove_unreferenced_vertices()
    assert solid.is_watertight and solid.volume > 0
    assert np.abs(shape(solid.vertices)).max() < 0.5 * 0.04
    assert np.abs(mesh.colors.astype(int) - [204, 102, 51]).max() <= 1
    assert mesh.facts["voxel"] == pytest.approx(0.4) and mesh.facts["truncation_m"] == pytest.approx(1.6)
    assert mesh.vertices.dtype == np.float32 and mesh.faces.dtype == np.int32


def test_automatic_lengths_are_those_of_the_pixels():
    given = subject(around(8), sphere)
    facts = TSDF().mesh(given).facts
    depths = [float(given.draw(view).median[given.draw(view).median > 0].median()) for view in given.views]
    assert facts["voxel_m"] == pytest.approx(np.median(depths) / 90 / 0.1, rel=1e-5)
    assert facts["truncation_m"] == pytest.approx(4 * facts["voxel_m"])
    assert facts["depth_limit_m"] == pytest.approx(2 * np.median(depths) / 0.1, rel=1e-5)
    assert TSDF(truncation_voxels=2.5).mesh(given).facts["truncation_m"] == pytest.approx(2.5 * facts["voxel_m"])
    coarser = TSDF(voxel_px=1.25).mesh(given).facts
    assert coarser["voxel_m"] == pytest.approx(1.25 * facts["voxel_m"])
    assert coarser["truncation_m"] == pytest.approx(4 * coarser["voxel_m"])
    unknown = TSDF().mesh(replace(given, frame=replace(given.frame, metres=None))).facts
    assert unknown["voxel"] == pytest.approx(facts["voxel"]) and "voxel_m" not in unknown


def test_the_automatic_depth_limit_reaches_what_is_seen_along_a_street():
    def street(points):
        return points[..., 2]

    given = subject([look_at((0.3 * x, 0.0, 0.2), (5.0, 0.5 * x - 1, 0.0)) for x in range(5)], street)
    depths = [given.draw(view).depth for view in given.views]
    median = np.median([float(depth[depth > 0].median()) for depth in depths])
    far = np.quantile(np.concatenate([depth[depth > 0].numpy() for depth in depths]), 0.98)
    facts = TSDF(voxel=0.5, least_views=0.01).mesh(given).facts
    assert facts["depth_limit_m"] == pytest.approx(far / 0.1, rel=1e-4) and far > 3 * median


def test_splats_behind_walls_do_not_make_automatic_voxels_larger(monkeypatch):
    given, fine = subject(around(8), sphere), TSDF(voxel_px=0.25, least_views=0.05)
    exact = fine.mesh(given)
    tensors = given.splats.tensors()
    shells = [tensors | {"means": size * tensors["means"]} for size in (1, 0.85, 0.7, 0.55)]
    both = Splats(given.splats.kind, *(torch.cat([shell[name] for shell in shells]) for name in tensors))
    hidden = replace(given, splats=both)
    kept = without_hidden(hidden, "median").means.norm(dim=1)
    assert len(given.splats) <= len(kept) < 1.1 * len(given.splats)
    assert kept.min() > 0.42, "3 % of the depth behind the surface"
    monkeypatch.setattr(tsdf, "AUTO_TRIANGLES", 2 * len(exact.faces))
    assert fine.mesh(hidden).facts["voxel"] == exact.facts["voxel"]
    monkeypatch.setattr(tsdf, "without_hidden", lambda subject, which: subject.splats)
    assert fine.mesh(hidden).facts["voxel"] > 1.04 * exact.facts["voxel"], "else they are counted"
    nothing = torch.zeros(72, 96, dtype=torch.bool)
    assert not len(without_hidden(replace(given, keep=lambda at: nothing), "median")), "masks hide too"
    away = replace(given, views=given.views[:1])
    assert len(without_hidden(away, "median")) < len(given.splats), "the back is hidden from the one view"
    turned = [replace(view, camera=look_at((0.0, 0.0, 5.0), (0.0, 0.0, 9.0))) for view in given.views]
    assert len(without_hidden(replace(given, views=turned), "median")) == len(given.splats), "nobody looks"


def test_an_automatic_voxel_grows_with_what_would_be_too_many_triangles(monkeypatch):
    given = subject(around(8), sphere)
    fine = TSDF().mesh(given)
    monkeypatch.setattr(tsdf, "AUTO_TRIANGLES", len(fine.faces) // 2)
    coarse = TSDF(truncation_voxels=3).mesh(given)
    assert 1.1 * fine.facts["voxel"] < coarse.facts["voxel"]
    assert coarse.facts["truncation"] == pytest.approx(3 * coarse.facts["voxel"])


def test_a_depth_limit_and_masks_leave_pixels_out():
    given = subject(around(16), slope)
    assert np.linalg.norm(TSDF(voxel=1.0).mesh(given).vertices, axis=1).max() > 1.5
    near = TSDF(voxel=1.0, depth_limit=19.0).mesh(given).vertices
    nearest = [np.linalg.norm(near - view.camera.centre.numpy(), axis=1).min() for view in given.views]
    assert min(nearest) < 1.95 and np.abs(slope(near)).max() < 0.05
    left = torch.zeros(72, 96, dtype=torch.bool)
    left[:, :48] = True
    one, mesher = subject(around(1, above=True), slope), TSDF(voxel=1.0, least_views=0.2)
    half, whole = mesher.mesh(replace(one, keep=lambda at: left)), mesher.mesh(one)
    assert 0.2 * len(whole.faces) < len(half.faces) < 0.7 * len(whole.faces)


def test_values_that_are_not_finite_are_no_depth():
    given = subject(around(12), sphere)
    spoilt = torch.zeros(72, 96, dtype=torch.bool)
    spoilt[::7, ::5] = True

    def draw(view):
        maps = given.draw(view)
        bad = torch.where(torch.arange(96) % 2 == 0, torch.nan, torch.inf).expand(72, 96)
        return replace(maps, median=torch.where(spoilt, bad, maps.median), color=torch.where(spoilt, bad, maps.color))

    mesh = TSDF(voxel=0.4).mesh(replace(given, draw=draw))
    assert np.isfinite(mesh.vertices).all() and np.abs(sphere(mesh.vertices)).max() < 0.02
    assert np.abs(mesh.colors.astype(int) - [204, 102, 51]).max() <= 1


def test_a_pixel_counts_by_its_angle_and_its_size():
    camera = around(1)[0]
    depth = torch.full((72, 96), 2.0)
    toward = -torch.nn.functional.normalize(camera.rays(), dim=0)
    flat = Maps(torch.zeros(3, 72, 96), torch.ones(72, 96), depth, depth, toward)
    weights = [picture(depth, flat, camera, voxel, 4 * voxel).shade >> 24 for voxel in (2 / 90, 1 / 90)]
    assert (weights[0] == 32).all() and (weights[1] == 8).all()
    sideways = torch.nn.functional.normalize(toward + torch.linalg.cross(toward, torch.rand(3, 72, 96), dim=0), dim=0)
    cosines = (sideways * toward).sum(0)
    aslant = picture(depth, replace(flat, normal=sideways), camera, 1.0, 4.0).shade >> 24
    assert np.allclose(aslant, np.round(32 * cosines.numpy()), atol=1)
    behind = picture(depth, replace(flat, normal=-toward), camera, 1.0, 4.0).shade >> 24
    assert (behind == 0).all()
    half = replace(flat, alpha=torch.full((72, 96), 0.4), depth=0.4 * depth)
    assert (depth_of(half, "expected") == 0).all() and torch.equal(depth_of(flat, "expected"), depth)


@pytest.mark.parametrize("carve", [False, True])
def test_tiles_join_to_what_one_grid_gives(monkeypatch, tmp_path, carve):
    given = replace(subject(around(16), torus), scratch=tmp_path)
    mesher = TSDF(voxel=0.3, carve=carve)
    whole = mesher.mesh(given)
    assert whole.facts["tiles"] == 1
    monkeypatch.setattr(tsdf, "plan", lambda found, most: cut_in_eight())
    tiled = mesher.mesh(given)
    assert tiled.facts["tiles"] == 8 and not list(tmp_path.iterdir())
    assert len(whole.faces) == len(tiled.faces) and np.array_equal(faces_by_place(whole), faces_by_place(tiled))
    assert len(np.unique(tiled.vertices, axis=0)) == len(tiled.vertices), "no vertex twice, and so no seam"


def cut_in_eight():
    boxes = [BlockRange()]
    for _ in range(3):
        boxes = [half for box in boxes for half in box.halves(BlockRange((-3, -2, -1), (2, 3, 2)))]
    return boxes


def test_a_grid_that_outgrows_its_memory_is_cut_until_it_fits(monkeypatch):
    given = subject(around(10), torus)
    whole = TSDF(voxel=0.3).mesh(given)
    made = []

    def counted(lattice):
        made.append(native.grid(lattice))
        return made[-1]

    monkeypatch.setattr(fusion, "grid", counted)
    monkeypatch.setattr(tsdf, "GRID_BUDGET_SHARE", 64 * tsdf.GRID_BYTES / given.budget_bytes)
    monkeypatch.setattr(tsdf, "estimate", lambda *_: tsdf.GridEstimate(np.zeros((1, 3), int), 1, 1))
    tiled = TSDF(voxel=0.3).mesh(given)
    assert tiled.facts["tiles"] >= 4 and max(grid.blocks for grid in made) <= 64
    assert np.array_equal(faces_by_place(whole), faces_by_place(tiled))


def test_the_estimate_is_of_the_right_size():
    from surfkit.mesh.grid_tiles import estimate

    for voxel in (0.015, 0.05):
        given = subject(around(24), sphere)
        made = native.grid(tsdf.Lattice(voxel, 4 * voxel))
        from .test_grid import plain

        for view in plain(around(24), sphere):
            made.fuse(view, False)
        found = estimate(given.splats, voxel, (np.full(3, -2.0), np.full(3, 2.0))).total
        assert 0.6 < found / made.blocks < 2.5, (voxel, found, made.blocks)


def test_blocks_are_counted_once_however_far_apart_they_are():
    draw = np.random.default_rng(0)
    for spread in (3, 10**6, 2**40):
        cells = draw.integers(-spread, spread, (500, 3)).repeat(2, 0)
        assert np.array_equal(different(cells), np.unique(cells, axis=0))
    assert different(np.zeros((0, 3), np.int64)).shape == (0, 3)
    wide = np.array([[-(2**62), 0, 0], [2**62, 0, 0], [-(2**62), 0, 0]])
    assert np.array_equal(different(wide), wide[:2]), "the distance between the two is no int64"


def test_progress_is_told():
    with listening(Progress, lambda event: (event.what, event.done, event.total)) as told:
        TSDF(voxel=1.0).mesh(subject(around(5), sphere))
    assert [done for _, done, _ in told] == [1, 2, 3, 4, 5] and {total for *_, total in told} == {5}
    assert "voxels of 1 m" in told[0][0]


def test_what_cannot_be_meshed_is_said():
    given = subject(around(5), sphere)
    empty = Maps(*[torch.zeros(shape) for shape in ((3, 72, 96), (72, 96), (72, 96), (72, 96), (3, 72, 96))])
    with pytest.raises(BadInput, match="5 views.*--mesh.depth expected"):
        TSDF().mesh(replace(given, draw=lambda view: empty))
    with pytest.raises(BadInput, match="no surface.*--mesh.least-views"):
        TSDF(voxel=1.0, least_views=900).mesh(given)
    with pytest.raises(BadInput, match="no surface"):
        TSDF(voxel=1.0, depth_limit=100.0).mesh(replace(given, draw=lambda view: empty))
    with pytest.raises(BadInput, match="5 m .*--metres-per-unit"):
        TSDF(voxel=5.0).mesh(replace(given, frame=replace(given.frame, metres=None)))
    with pytest.raises(BadInput, match=r"million triangles.* GB.*--mesh.voxel 0\.\d+ m"):
        TSDF(voxel=0.003).mesh(replace(given, budget_bytes=200_000_000))
    with pytest.raises(BadInput, match="too small .* m; give .* m"):
        TSDF(voxel=1e-5, depth_limit=100.0).mesh(given)
    with pytest.raises(BadInput, match="truncation is 1 m .*1 m.*1.75"):
        TSDF(voxel=1.0, truncation=1.0).mesh(given)
    with pytest.raises(BadInput, match="1 MB are too little"):
        TSDF().mesh(replace(given, budget_bytes=1_000_000))
    with pytest.raises(BadInput, match="no splats or no views"):
        TSDF().mesh(replace(given, views=[]))
    for wrong in (
        {"truncation_voxels": 1.0},
        {"voxel_px": 0.0},
        {"voxel_px": float("nan")},
        {"voxel": 0.0},
        {"truncation": -1.0},
        {"depth_limit": float("inf")},
        {"least_views": 0.0},
    ):
        with pytest.raises(BadInput, match=next(iter(wrong))):
            TSDF(**wrong)


def test_distances_are_to_the_plane_that_a_pixel_shows():
    """The ground z = 0 seen at 45 degrees: along the rays it would be up to 1.8 times as far."""
    camera = look_at((1.0, 0.1, 1.0), (0.0, 0.1001, 0.0))
    maps = maps_of(camera, lambda points: points[..., 2])
    found = picture(maps.median, maps, camera, 0.02, 0.08)
    off = []
    for some in (found, replace(found, slant=None)):
        grid = ReferenceGrid(Lattice(0.02, 0.08))
        assert grid.fuse(some, True)
        at = np.indices((8, 8, 8)).reshape(3, -1)[::-1].T + 8 * unpack(grid.keys)[:, None]
        height, distance = 0.02 * at[..., 2], grid.distance / 32767 * 0.08
        beside = np.linalg.norm(0.02 * at[..., :2] - [0, 0.1], axis=-1)
        sure = (grid.weight > 0) & (np.abs(height) < 0.05) & (beside < 0.2)
        assert sure.sum() > 1000 and (height[sure] < -0.03).any()
        off.append(np.abs(distance - height)[sure])
    assert off[0].max() < 0.0008 and np.median(off[1]) > 0.004


def test_a_tile_gets_all_views_that_reach_into_it():
    """A pixel seen from the side reaches further behind its surface, along the ray, than the truncation."""
    lattice = Lattice(0.01, 0.4)
    camera = look_at((0, 0, 2.0), (0, 0.0001, 0.0))
    task = fusion.FusionTask(lattice, (camera,), lambda at: None, 1.0, True, 1, None)
    lowest = 2.0 - 1.0 - lattice.truncation / lattice.least_slant
    assert fusion.in_sight(camera, task).low[2] * BLOCK_SIDE_VOXELS * lattice.voxel <= lowest


def test_a_surface_seen_from_the_side_has_no_holes():
    """With the least truncation, the shell behind the ground is thinner along the rays than a cell is wide."""
    camera = look_at((1.6, 0.1, 1.0), (0.0, 0.1001, 0.0))
    maps = maps_of(camera, lambda points: points[..., 2])
    found, places = picture(maps.median, maps, camera, 0.03, MIN_TRUNCATION_VOXELS * 0.03), []
    for some in (found, replace(found, slant=None)):
        grid = ReferenceGrid(Lattice(0.03, MIN_TRUNCATION_VOXELS * 0.03))
        assert grid.fuse(some, True)
        piece = grid.surface(1)
        middles = piece.vertices[piece.faces].mean(1)
        near = np.linalg.norm(middles[:, :2] - [0, 0.1], axis=1) < 0.3
        corners = piece.vertices[piece.faces[near]].astype(np.float64)
        places.append(
            np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
        )
    assert places[0] == pytest.approx(np.pi * 0.3**2, rel=0.03) and places[1] < 0.9 * places[0]


def test_a_road_seen_by_someone_who_walks_on_it_is_whole():
    """At the far end, rows of pixels lie 3 voxels apart in depth, and rays meet the ground at 15 degrees."""
    turn = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    camera = Camera(pose, 250.0, 250.0, 75.0, -25.0, 150, 190)  # the lower middle of a photograph
    maps = maps_of(camera, lambda points: points[..., 2])
    voxel, cut = 0.04, MIN_TRUNCATION_VOXELS * 0.04
    road = ReferenceGrid(Lattice(voxel, cut))
    assert road.fuse(picture(torch.where(maps.median < 20, maps.median, 0), maps, camera, voxel, cut), True)
    piece = road.surface(1)
    corners = piece.vertices[piece.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    middles = corners.mean(1)
    for near, far in ((4, 5.5), (5.5, 7.5)):
        there = (middles[:, 0] > near) & (middles[:, 0] < far) & (np.abs(middles[:, 1]) < 0.5)
        assert area[there].sum() == pytest.approx(far - near, rel=0.03), (near, far)
        assert np.abs(middles[there, 2]).max() < 0.0001


def test_no_pixel_reaches_further_than_the_compiled_grid_looks():
    """It leaves out blocks by the least slant that there can be, a constant in mesh/cpu/fuse.h."""
    header = (Path(native.__file__).parent / "cpu" / "fuse.h").read_text()
    (bound,) = re.findall(r"kLeastSlant = ([0-9.]+)f;", header)
    assert 0.98 * least_slant(1.0, MIN_TRUNCATION_VOXELS) < float(bound) <= least_slant(1.0, MIN_TRUNCATION_VOXELS)


@needs_native
def test_compiled_shades_are_those_of_numpy(monkeypatch):
    maps, camera = maps_of(around(1)[0], sphere), around(1)[0]
    noisy = replace(maps, color=maps.color + torch.randn(3, 72, 96), normal=maps.normal + 0.3 * torch.randn(3, 72, 96))
    noisy.color[0, 3, 4], noisy.normal[:, 36, 50] = torch.nan, 0
    for some in (noisy, replace(noisy, normal=None)):
        one = picture(maps.depth, some, camera, 0.015, 0.03)
        monkeypatch.setattr("surfkit.mesh.fusion_image.module", lambda: None)
        other = picture(maps.depth, some, camera, 0.015, 0.03)
        monkeypatch.undo()
        assert np.array_equal(one.shade, other.shade) and len(np.unique(one.shade >> 24)) > 5
        assert np.array_equal(one.slants, other.slants) and one.slants.dtype == np.float32
        least = 1 if some.normal is None else least_slant(0.015, 0.03)
        assert one.slants.min() == pytest.approx(least) and (least < 1 or (one.slants == 1).all())


def test_one_view_alone_counts_if_it_may():
    mesh = TSDF(voxel=0.5, least_views=0.1).mesh(subject(around(1, above=True), slope))
    assert len(mesh.faces) > 100


def test_the_reference_gives_the_same_mesh(monkeypatch):
    given = subject(around(4), sphere)
    compiled = TSDF(voxel=0.6).mesh(given)
    monkeypatch.setattr(native, "module", lambda: None)
    with_numpy = TSDF(voxel=0.6).mesh(given)
    assert np.array_equal(compiled.vertices, with_numpy.vertices) and np.array_equal(compiled.faces, with_numpy.faces)
    assert np.array_equal(compiled.colors, with_numpy.colors)


def test_normals_are_not_needed():
    cameras = around(12)
    given = subject(cameras, sphere)
    bare = replace(given, draw=lambda view: replace(maps_of(view.camera, sphere), normal=None))
    assert np.abs(sphere(TSDF(voxel=0.4).mesh(bare).vertices)).max() < 0.02
