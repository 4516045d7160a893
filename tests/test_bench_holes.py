"""`bench/holes.py`: a map with a hole of known size below cameras at known places."""

import importlib.util
import json

import numpy as np
import pytest
import torch
from needs import needs
from pages import ROOT

from surfkit.apps.maps.map_grid import MapGrid
from surfkit.core.check import BadInput
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame

rasterio = needs("rasterio")
trimesh = needs("trimesh")
GRID = MapGrid(np.eye(3), 0.5, -100, 80, 200, 160)
"""100 m by 80 m from x = -50 to 50 and from y = -40 to 40."""


@pytest.fixture(scope="module")
def holes():
    spec = importlib.util.spec_from_file_location("holes", ROOT / "bench" / "holes.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Looks:
    """A view straight down from (x, 0, 100): 40 m to each side are in its picture on the ground, 30 m up and down."""

    def __init__(self, x):
        pose = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
        pose[:3, 3] = torch.tensor([-x, 0, 100.0])
        self.camera = Camera(pose, 100.0, 100.0, 40.0, 30.0, 80, 60)


FRAME = Frame(np.zeros(3), 1.0)


def test_the_share_of_cells_without_a_surface(holes):
    """Views at x = -20, 0 and 20 all see -20 to 20, that is 80 by 120 cells; the hole is 10 by 10, half of it there."""
    heights, views = np.zeros((160, 200)), [Looks(-20), Looks(0), Looks(20)]
    heights[75:85, 135:145] = np.nan
    found, outline = holes.map_holes(heights, np.isfinite(heights), GRID, views, FRAME)
    assert outline.all() and (found["cells"], found["seen"]) == (160 * 200, 80 * 120)
    assert found["without_height"] == found["without_color"] == 50 / (80 * 120)
    found, _ = holes.map_holes(heights, np.isfinite(heights), GRID, views[:2], FRAME)
    assert found["seen"] == 0 and found["without_height"] is None and json.dumps(found)


def test_what_is_high_is_seen_by_fewer(holes):
    """At half of the flying height pictures are half as wide: no place has all three views; above it none has any."""
    views = [Looks(-20), Looks(0), Looks(20)]
    for height in (50.0, 150.0):
        found, _ = holes.map_holes(np.full((160, 200), height), np.ones((160, 200), bool), GRID, views, FRAME)
        assert found["seen"] == 0
    found, _ = holes.map_holes(np.full((160, 200), 25.0), np.ones((160, 200), bool), GRID, views, FRAME)
    assert found["seen"] == 40 * 90


def test_wide_gaps_are_not_within_the_outline(holes):
    covered = np.ones((200, 300), bool)
    covered[:, 100:148] = covered[:, 200:254] = covered[60:100, 20:60] = False
    outline = holes.outline_of(covered)
    assert outline[60:140, :200].all(), "a gap of 48 cells, and a hole of 40"
    assert not outline[:, 201:253].any(), "a gap of 54 cells"


def test_heights_of_holes_are_linear_between_the_cells_around(holes):
    y, x = np.mgrid[:40, :50]
    plane = 0.5 * x - 0.25 * y + 3
    heights = np.where((np.hypot(x - 20, y - 20) < 8) | (x > 45), np.nan, plane)
    found = holes.filled(heights, x <= 45)
    assert np.allclose(found[x <= 45], plane[x <= 45]) and np.isnan(found[x > 45]).all()


def test_cells_have_their_places(holes):
    """Back by `MapGrid.to_cells`, of a frame with y up."""
    turned = MapGrid(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), 0.25, -3, 7, 9, 8)
    cells = np.argwhere(np.ones((8, 9), bool))
    places = turned.to_cells(holes.cell_places(turned, np.arange(72.0).reshape(8, 9), cells))
    assert np.allclose(places, np.column_stack([cells[:, 1] + 0.5, cells[:, 0] + 0.5, np.arange(72)]))


def test_edges_away_from_the_rim(holes, tmp_path):
    """A plate of 1 m squares without one square: four edges in the middle, and those of the rim do not count."""
    x, y = np.meshgrid(np.arange(-50, 51), np.arange(-40, 41))
    at = np.flatnonzero(((x < 50) & (y < 40)).ravel())
    faces = np.concatenate([np.stack([at, at + 1, at + 102], 1), np.stack([at, at + 102, at + 101], 1)])
    at_hole = np.isin(faces[:, 0], np.flatnonzero(((x == 5) & (y == 5)).ravel()))
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    trimesh.Trimesh(vertices, faces[~at_hole], process=False).export(tmp_path / "mesh.ply")
    views = [Looks(-20), Looks(0), Looks(20)]
    found = holes.mesh_holes(tmp_path / "mesh.ply", GRID, np.ones((160, 200), bool), views, FRAME)
    assert (found["boundary"], found["away_from_rim"]) == (2 * (100 + 80) + 4, 4)
    assert found["share"] == 4 / found["edges"]
    near = np.zeros((160, 200), bool)
    near[60:80, 100:130] = True  # the hole is less than 25 cells from the border of this outline
    assert holes.mesh_holes(tmp_path / "mesh.ply", GRID, near, views, FRAME)["away_from_rim"] == 0


def test_pieces_of_contour_lines(holes, tmp_path):
    """A cone, cut open by a hole: each ring that goes through the hole is one open line."""
    y, x = np.mgrid[:160, :200]
    cone = 50 - 0.5 * np.hypot(x - 100, y - 80)
    (tmp_path / "maps.json").write_text(json.dumps({"contours": {"interval": 5.0, "lines": 99}}))
    found = holes.contour_pieces(cone, GRID, tmp_path)
    whole = 160 // 2 // 10 - 1  # rings of 10 cells more each, that lie within the map
    assert found["in_file"] == 99 and found["closed"] == whole
    cone[80:90, 115:125] = np.nan
    assert holes.contour_pieces(cone, GRID, tmp_path)["closed"] == whole - 1
    assert holes.contour_pieces(cone, GRID, tmp_path)["pieces"] == found["pieces"]


def test_a_folder_without_a_run(holes, tmp_path):
    with pytest.raises(BadInput):
        holes.measure(tmp_path, tmp_path / "maps")
