"""The mosaic of photographs that an orthophoto is: cut lines, blending, and what no photograph shows."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image
from town import Town, looking, seen_from, sheet

from surfkit.apps.maps import orthophoto, photo_regions
from surfkit.apps.maps.graph_cut import expanded
from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.scene import one_light
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, Mask, View
from surfkit.scene.srgb import from_linear, linear
from surfkit.scene.track_colors import TrackColors
from surfkit.scene.track_light import fit_light
from surfkit.testing.synthetic import Box, GroundPlane

rasterio = needs("rasterio")
needs("cv2")
HALF, SIDE, FOCAL = 6.0, 160, 120.0
HIDDEN = (20, 20, 230)
"""Colour of all vertices."""
RED, GREEN = np.array([0.8, 0.1, 0.1]), np.array([0.2, 0.6, 0.2])
"""Of the box, and of the ground about."""
NOTHING = TrackColors(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 3)))
SETTINGS = MapSettings(products=("orthophoto",), colors="photographs", gsd=0.05, up="z", memory="100MB")


def leave_the_light(monkeypatch):
    """As if photographs shared nothing."""
    monkeypatch.setattr(one_light, "fit_light", lambda _, *others: fit_light(NOTHING, *others))


def ground_colors(places):
    """(P, 3) colours: green, with gentle waves."""
    x, y = places[:, 0], places[:, 1]
    return GREEN + 0.05 * np.stack([np.sin(x + y), np.cos(1.3 * x), np.sin(0.7 * y)], 1)


def scene_of(folder, poses, box=None, exposures=None):
    """The ground with a box on it, and photographs of it."""
    views, frame = [], Frame(np.zeros(3), 0.1, 1.0)
    for at, pose in enumerate(poses):
        camera = Camera(frame.local_pose(pose), FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)
        rays = camera.rays(torch.float64).flatten(1).T.numpy() @ pose[:3, :3]
        eye = -pose[:3, :3].T @ pose[:3, 3]
        far, which = seen_from(eye, rays, [GroundPlane(), *([box] if box else [])])
        far[~np.isfinite(far)] = 0
        color = np.where(which[:, None] == 1, RED, ground_colors(eye + far[:, None] * rays))
        color = from_linear((linear(color) * (1.0 if exposures is None else exposures[at])).clip(0, 1))
        path = folder / f"{at}.png"
        Image.fromarray(np.rint(255 * color).astype(np.uint8).reshape(SIDE, SIDE, 3)).save(path)
        views.append(View(path.name, camera, path))
    x, y, z = np.eye(3)
    sheets = [sheet((-HALF, -HALF, 0), 2 * HALF * x, 2 * HALF * y, 0.5)]
    if box:
        low, size = np.array(box.low), np.subtract(box.high, box.low)
        sheets += [sheet((*low[:2], box.high[2]), size[0] * x, size[1] * y, 0.5)]
        for corner, along in ((low, x), (low + size[1] * y, x), (low, y), (low + size[0] * x, y)):
            sheets.append(sheet(corner, (size @ along) * along, size[2] * z, 0.5))
    starts = np.cumsum([0, *(len(places) for places, _ in sheets)])
    rows = np.zeros(starts[-1], [*((axis, "<f8") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    rows["x"], rows["y"], rows["z"] = np.concatenate([places for places, _ in sheets]).T
    rows["red"], rows["green"], rows["blue"] = HIDDEN
    faces = np.concatenate([part + start for (_, part), start in zip(sheets, starts, strict=False)])
    return Town(SurfaceFile("mesh.ply", rows, faces.astype(np.int32)), frame, tuple(views))


def down(x, y=0.0, height=10.0):
    return looking((x, y, height), (x, y, 0.0))


def drawn(scene, out, settings=SETTINGS):
    """(H, W, 3) colours, (H, W) numbers of photographs, and (H, W, 2) places of the centres of cells."""
    record = make_maps(MeshWithPhotos(scene.surface, scene.frame, scene.views), settings, out)
    with rasterio.open(out / "orthophoto.tif") as file:
        colors = file.read()[:3].transpose(1, 2, 0).astype(float)
    with rasterio.open(out / "orthophoto-photographs.tif") as file:
        numbers = file.read(1).astype(int)
    west, _, _, north = record["bounds"]
    row, column = np.indices(numbers.shape) + 0.5
    return colors, numbers, np.stack([west + column * record["gsd"], north - row * record["gsd"]], -1)


def steps_between(colors, numbers):
    """(n,) steps of green over borders of photographs, along the rows."""
    seam = (numbers[:, 1:] != numbers[:, :-1]) & (numbers[:, 1:] > 0) & (numbers[:, :-1] > 0)
    return np.abs(np.diff(colors[..., 1], axis=1))[seam]


def test_two_photographs_of_other_exposure_have_no_seam(tmp_path):
    scene = scene_of(tmp_path, [down(-2), down(2)], exposures=[0.8, 1.25])
    colors, numbers, places = drawn(scene, tmp_path / "maps")
    assert {1, 2} <= set(np.unique(numbers)), "both are used"
    exact = 255 * ground_colors(places.reshape(-1, 2)).reshape(colors.shape)
    assert np.abs(colors - exact)[numbers > 0].max() < 4, "in the light of their mean"
    assert steps_between(colors, numbers).max() <= 2


def test_what_light_is_not_known_is_blended(tmp_path, monkeypatch):
    """Photographs that differ by 22 levels, and gains that do not tell: the change takes many cells."""
    leave_the_light(monkeypatch)
    monkeypatch.setattr(photo_regions, "MOST_SEAM", 1.0)
    scene = scene_of(tmp_path, [down(-2), down(2)], exposures=[1.0, 1.3])
    colors, numbers, places = drawn(scene, tmp_path / "maps")
    plain = 255 * ground_colors(places.reshape(-1, 2)).reshape(colors.shape)[..., 1]
    off = colors[..., 1] - plain
    assert np.median(off[(numbers == 2) & (places[..., 0] > 4)]) > 15
    assert np.abs(np.median(off[(numbers == 1) & (places[..., 0] < -4)])) < 1
    assert steps_between(off[..., None].repeat(2, 2), numbers).max() < 3
    # without blending, the whole difference is one step
    monkeypatch.setattr(orthophoto.Square, "_blended", lambda self: (self.color // orthophoto.FINE).astype(np.uint8))
    cut, numbers, _ = drawn(scene, tmp_path / "cut")
    assert np.median(steps_between(cut, numbers)) > 15


@pytest.mark.parametrize("cost", [photo_regions.RAISED_COST, 0.0])
def test_a_cut_line_goes_round_a_box(tmp_path, monkeypatch, cost):
    """Two photographs on both sides of a box show its roof equally well."""
    monkeypatch.setattr(photo_regions, "RAISED_COST", cost)
    scene = scene_of(tmp_path, [down(-3), down(3)], Box((-1.5, -1.0, 0.0), (1.5, 1.0, 1.0)))
    _, numbers, places = drawn(scene, tmp_path / "maps")
    roof = (np.abs(places) < (1.3, 0.8)).all(-1)
    share = (numbers[roof] == 1).mean()
    assert (share in (0.0, 1.0)) == (cost > 0)
    assert 0.3 < (numbers[numbers > 0] == 1).mean() < 0.7, "each has its side"


def test_what_is_hidden_is_not_painted_with_what_hides_it(tmp_path):
    box = Box((-1.0, -1.0, 0.0), (1.0, 1.0, 3.0))
    scene = scene_of(tmp_path, [looking((-8.0, 0.0, 8.0), (0.0, 0.0, 0.0))], box)
    colors, numbers, places = drawn(scene, tmp_path / "maps")
    behind = (places[..., 0] > 1.1) & (places[..., 0] < 3.5) & (np.abs(places[..., 1]) < 0.9)
    assert (numbers[behind] == 0).all() and (colors[behind] == HIDDEN).all()
    roof = (np.abs(places) < 0.9).all(-1)
    assert (numbers[roof] == 1).all() and np.abs(colors[roof] - 255 * RED).max() < 3
    ground = ~(np.abs(places) < 1.25).all(-1) & (numbers == 1)  # at the wall, pixels of the photograph show both
    assert (colors[ground][:, 1] > 110).all(), "no red on the ground"
    # another photograph that sees the ground behind takes it over
    other = scene_of(tmp_path, [looking((-8.0, 0.0, 8.0), (0.0, 0.0, 0.0)), looking((8, 0, 8), (0, 0, 0))], box)
    colors, numbers, _ = drawn(other, tmp_path / "both")
    assert (numbers[behind] == 2).all() and (colors[behind][:, 1] > 110).all()


def test_masked_pixels_are_not_used(tmp_path):
    scene = scene_of(tmp_path, [down(0)])
    mask = np.full((SIDE, SIDE), 255, np.uint8)
    mask[:, SIDE // 2 :] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    views = (replace(scene.views[0], mask=Mask(tmp_path / "mask.png")),)
    _, numbers, places = drawn(replace(scene, views=views), tmp_path / "maps")
    inner = np.abs(places).max(-1) < 5
    kept = inner & (places[..., 0] < -0.1)
    assert (numbers[kept] == 1).all() and (numbers[inner & (places[..., 0] > 0.1)] == 0).all()


def test_squares_do_not_show(tmp_path, monkeypatch):
    """Squares of any size come to the same: their margins are wide enough."""
    leave_the_light(monkeypatch)
    scene = scene_of(tmp_path, [down(-2), down(2, 1)], Box((-1, -1, 0), (1, 1, 1)), [1.0, 1.3])
    found = []
    for side in (32, 96, 1024):
        monkeypatch.setattr(orthophoto, "SIDE", side)
        found.append(drawn(scene, tmp_path / str(side)))
    for colors, numbers, _ in found[1:]:
        assert np.array_equal(numbers, found[0][1]) and np.abs(colors - found[0][0]).max() <= 1


class Grid:
    """Random costs of labels on a grid of 3 x 4 nodes."""

    def __init__(self, seed, labels):
        draw = np.random.default_rng(seed)
        number = np.arange(12).reshape(3, 4)
        across, along = (number[:, :-1], number[:, 1:]), (number[:-1], number[1:])
        self.edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in (across, along)])
        self.cost, self.weight = draw.uniform(0, 2, (12, labels)), draw.uniform(0, 1, len(self.edges))

    def nodes_of(self, label):
        return np.arange(12)

    def node_costs(self, nodes, label):
        return self.cost[nodes, label]

    def edge_costs(self, edges, one, other):
        return np.where(one != other, self.weight[edges], 0.0)

    def energy(self, label):
        ends = label[self.edges].T
        return self.node_costs(np.arange(12), label).sum() + self.edge_costs(np.arange(len(self.edges)), *ends).sum()


@pytest.mark.parametrize("seed", range(5))
def test_cuts_of_two_labels_are_the_best_of_all(seed):
    grid = Grid(seed, 2)
    least = min(grid.energy(np.array(label)) for label in product((0, 1), repeat=12))
    assert grid.energy(expanded(grid, np.zeros(12, int), np.arange(2))) == pytest.approx(least, abs=1e-5)


def test_no_offer_lowers_the_energy_of_many_labels():
    grid, draw = Grid(7, 5), np.random.default_rng(0)
    found = expanded(grid, np.zeros(12, int), np.arange(5))
    for _ in range(2000):
        other = np.where(draw.random(12) < draw.random(), draw.integers(5), found)
        assert grid.energy(other) >= grid.energy(found) - 1e-5
