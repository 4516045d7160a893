"""The terrain model against hills whose heights are known in closed form, with houses and trees on them."""

import numpy as np
import pytest
from interrupted import digests, interrupted_often
from needs import needs

from surfkit.apps.maps import terrain
from surfkit.apps.maps.ground_filter import between_cells, fill_smoothly, roughness
from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.maps.terrain import TerrainSettings
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.core.check import BadInput
from surfkit.scene.scene import Frame

from .shapes import UTM, centres, gpkg_version, grid_of, heightfield, surface_of

rasterio = needs("rasterio")
FRAME = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, "EPSG:32633")
SIDE, GSD = 100.0, 0.5
HOUSES = ((20, 20, 18, 12, 8.0), (60, 15, 30, 25, 15.0), (88, 50, 12, 20, 6.0), (40, 60, 10, 10, 4.0))
"""West, south, width, depth and height in metres; the third is cut by the border of the map."""
TREES = ((25, 50, 2.5, 7.0), (70, 60, 3.0, 9.0), (20, 80, 2.0, 6.0), (75, 80, 3.0, 8.0))
"""Middle, radius and height."""
SETTINGS = MapSettings(("terrain",), GSD, up="z")


def hills(x, y):
    return 30 + 2 * np.sin(x / 25) + 1.5 * np.cos(y / 18)


def plane(x, y):
    return 30 + 0.12 * x - 0.08 * y


def things(x, y):
    """Heights above ground, and which of them are of houses and of trees."""
    above, house, tree = np.zeros_like(x), np.zeros(x.shape, bool), np.zeros(x.shape, bool)
    for west, south, width, depth, height in HOUSES:
        inside = (x >= west) & (x <= west + width) & (y >= south) & (y <= south + depth)
        above[inside], house[inside] = height, True
    for column, row, radius, height in TREES:
        off = (x - column) ** 2 + (y - row) ** 2
        inside = off <= radius**2
        above[inside] = height - 3 + 3 * np.sqrt(1 - off[inside] / radius**2)
        tree[inside] = True
    return above, house, tree


def scene(ground, unit=1.0, count=251, colored=True, objects=things):
    """A mesh of ground and things on it, in units of so many metres."""

    def height(x, y):
        u, v = (x - UTM[0]) * unit, (y - UTM[1]) * unit
        return (ground(u, v) + objects(u, v)[0]) / unit

    def color(x, y):
        _, _, tree = objects((x - UTM[0]) * unit, (y - UTM[1]) * unit)
        return np.where(tree[:, None], [50, 100, 40], [120, 118, 116])

    side = SIDE / unit
    return heightfield(height, UTM, (UTM[0] + side, UTM[1] + side), count, color if colored else None)


def read(path):
    with rasterio.open(path) as file:
        return file.read(1, masked=True).astype(float).filled(np.nan)


def places(gsd=GSD, unit=1.0):
    """Metres from the corner of the map, of the centres of cells."""
    side = SIDE / unit
    x, y = centres(grid_of(gsd, *UTM, UTM[0] + side, UTM[1] + side))
    return (x - UTM[0]) * unit, (y - UTM[1]) * unit


def rms(values):
    return np.sqrt(np.mean(values**2))


@pytest.mark.parametrize("ground", [hills, plane])
def test_the_terrain_is_the_ground_below_houses_and_trees(tmp_path, ground):
    record = make_maps(MeshWithPhotos(scene(ground), FRAME), SETTINGS, tmp_path)
    assert record["files"] == ["dsm.tif", "dtm.tif", "ndsm.tif", "ground-distance.tif"]
    dsm, dtm, above, distance = (read(tmp_path / name) for name in record["files"])
    exact, (there, house, tree) = ground(*places()), things(*places())
    bare = there == 0
    assert np.isfinite(dtm).all() and record["terrain"]["without_terrain"] == 0
    assert rms((dtm - exact)[bare]) < 0.05, "seen ground is what the surface model has"
    assert rms((dtm - exact)[house | tree]) < 0.3, "a smooth interpolation of hills below houses of 30 m"
    beside = places()[0] > 87  # the house that the border of the map cuts has no ground on one side
    assert np.abs(dtm - exact)[~beside].max() < 0.8 and np.abs(dtm - exact)[beside].max() < 1.2
    assert above[house & beside].mean() > 5, "6 m high"
    assert np.nanmax(np.abs(above - (dsm - dtm))) < 1e-5
    assert abs(record["terrain"]["ground_seen"] - bare.mean()) < 0.02
    assert distance[bare].max() < 2 and 11 < distance[house].max() < 13.5, "half of the depth of the widest house"
    with rasterio.open(tmp_path / "dtm.tif") as file, rasterio.open(tmp_path / "dsm.tif") as model:
        assert (file.crs, file.transform, file.nodata) == (model.crs, model.transform, model.nodata)
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG" and file.dtypes == ("float32",)


def test_contour_lines_of_the_terrain_do_not_go_around_houses(tmp_path):
    raw = needs("pyogrio.raw")
    settings = MapSettings(("contours", "terrain"), GSD, up="z", interval=1.0, shortest=15.0)
    record = make_maps(MeshWithPhotos(scene(plane), FRAME), settings, tmp_path)
    assert record["files"][-1] == "contours-terrain.gpkg" and (tmp_path / "contours-terrain.gpkg").exists()
    meta, _, shapes, (levels,) = raw.read(tmp_path / "contours-terrain.gpkg", layer="contours_terrain")
    assert len(levels) == record["terrain_contours"]["lines"] < record["contours"]["lines"]
    assert list(meta["fields"]) == ["elevation"] and gpkg_version(tmp_path / "contours-terrain.gpkg") == 10200
    for level, shape in zip(levels, shapes, strict=True):
        u, v = (np.frombuffer(shape[9:], "<f8").reshape(-1, 2) - UTM).T
        assert np.abs(plane(u, v) - level).max() < 1.2, "the ground, below houses too"
        assert np.hypot(*np.diff([u, v])).sum() >= 15


def test_results_do_not_depend_on_tiles(tmp_path, monkeypatch):
    surface, found = scene(hills, count=101), []
    settings = {"products": ("terrain", "points"), "gsd": 0.25, "spacing": 1.0, "up": "z"}
    needs("laspy"), needs("lazrs")
    for tile, block in ((2048, 2048), (101, 52)):
        monkeypatch.setattr(terrain, "BLOCK_CELLS", block)
        out = tmp_path / str(tile)
        record = make_maps(MeshWithPhotos(surface, FRAME), MapSettings(tile=tile, **settings), out)
        rasters = [read(out / name).tobytes() for name in ("dtm.tif", "ndsm.tif", "ground-distance.tif")]
        found.append((*rasters, record["terrain"], (out / "points.copc.laz").read_bytes()))
    assert found[0] == found[1]


def test_points_have_classes(tmp_path):
    laspy = needs("laspy")
    needs("lazrs")
    settings = MapSettings(("terrain", "points"), GSD, up="z")
    for colored in (True, False):
        out = tmp_path / str(colored)
        record = make_maps(MeshWithPhotos(scene(hills, colored=colored), FRAME), settings, out)
        points = laspy.read(out / "points.copc.laz")
        kinds, x, y = np.asarray(points.classification), points.x - UTM[0], points.y - UTM[1]
        assert record["points"]["classes"] == {str(kind): int((kinds == kind).sum()) for kind in np.unique(kinds)}
        above, house, tree = things(np.asarray(x), np.asarray(y))
        ground = (above == 0) & (np.abs(points.z - hills(x, y)) < 0.2)
        roof = house & (points.z - hills(x, y) > above - 0.1)
        assert (kinds[ground] == 2).mean() > 0.99 and (kinds[house | tree] == 2).mean() < 0.03
        assert (kinds[roof] == 6).mean() > (0.95 if colored else 0.85)
        assert (kinds[tree] == 5).mean() > 0.7 if colored else not (kinds == 5).any()
        assert (kinds[tree] == 6).mean() < (0.02 if colored else 0.2)


def test_a_surface_that_is_all_roof_is_taken_for_ground(tmp_path):
    surface = heightfield(lambda x, y: 0 * x + 50.0, UTM, (UTM[0] + 30, UTM[1] + 20), 30)
    make_maps(MeshWithPhotos(surface, FRAME), SETTINGS, tmp_path)
    assert np.abs(read(tmp_path / "dtm.tif") - 50).max() < 1e-5 and read(tmp_path / "ndsm.tif").max() == 0


@pytest.mark.parametrize("depth", [0.3, 8.0])
def test_a_surface_below_the_terrain_is_told(tmp_path, warned, depth):
    """Pits below trees, in 15 x 15 m of 1 % of the map; of the depth of noise they are ground."""

    def pits(x, y):
        none = np.zeros(x.shape, bool)
        where = (np.abs(x - 30) < 7.5) & (np.abs(y - 30) < 7.5) & (np.floor(x) % 5 < 1)
        return np.where(where, -depth, 0.0), none, none

    record = make_maps(MeshWithPhotos(scene(plane, objects=pits), FRAME), SETTINGS, tmp_path)
    above = read(tmp_path / "ndsm.tif")
    share = float((above < -1).mean())
    assert abs(record["terrain"]["below_terrain"] - share) < 0.002
    told = [each for each in warned if "below the terrain" in str(each)]
    assert (share > 0.005, len(told)) == ((True, 1) if depth > 1 else (False, 0))


def test_ridges_stay(tmp_path):
    """An opening cuts ridges off; steep ones need a larger --terrain.slope."""
    errors = {}
    for slope in (0.15, 0.6):
        settings = MapSettings(("terrain",), GSD, up="z", terrain=TerrainSettings(slope=slope))
        surface = scene(ridge, count=151, objects=lambda x, y: (0 * x, None, x < 0))
        make_maps(MeshWithPhotos(surface, FRAME), settings, tmp_path / str(slope))
        errors[slope] = rms(read(tmp_path / str(slope) / "dtm.tif") - ridge(*places()))
    assert errors[0.6] < 0.05 and errors[0.15] < 1.0


def ridge(x, y):
    return 60 - 0.4 * np.abs(x - 50)


def holed(side):
    """A plane of 60 x 60 m with a square hole in the middle."""
    surface = heightfield(lambda x, y: plane(x - UTM[0], y - UTM[1]), UTM, (UTM[0] + 60, UTM[1] + 60), 121)
    middles = surface.vertices()[surface.faces].mean(1)[:, :2] - UTM - 30
    return surface_of(surface.vertices(), surface.faces[np.abs(middles).max(1) > side / 2])


def test_there_is_no_terrain_far_from_ground_that_is_seen(tmp_path):
    settings = MapSettings(("terrain",), GSD, up="z", terrain=TerrainSettings(building_width=10))
    make_maps(MeshWithPhotos(holed(36.0), FRAME), settings, tmp_path)
    dsm, dtm, distance = (read(tmp_path / name) for name in ("dsm.tif", "dtm.tif", "ground-distance.tif"))
    x, y = centres(grid_of(GSD, *UTM, UTM[0] + 60, UTM[1] + 60))
    inside = 18 - np.maximum(np.abs(x - UTM[0] - 30), np.abs(y - UTM[1] - 30))
    assert np.isnan(dtm[inside > 11]).all() and np.isfinite(dtm[inside < 9]).all()
    assert np.isnan(dsm[inside > 1]).all() and np.array_equal(np.isnan(dtm), np.isnan(distance))
    near = (inside > 1) & (inside < 9)
    assert np.abs(dtm - plane(x - UTM[0], y - UTM[1]))[near].max() < 0.1
    assert np.abs(distance - inside)[near].max() < 1.5


def test_feet_are_not_metres(tmp_path):
    """The same scene in US survey feet: the same cells are ground."""
    foot = 0.3048006096012192
    found = {}
    for name, unit, crs in (("m", 1.0, "EPSG:32633"), ("ft", foot, "EPSG:2263")):
        frame = Frame(np.array([*UTM, 0.0]), 0.01, unit, crs)
        settings = MapSettings(("terrain",), GSD, bounds=bounds(unit), up="z")
        record = make_maps(MeshWithPhotos(scene(hills, unit, 151), frame), settings, tmp_path / name)
        found[name] = record["terrain"]
    assert found["ft"]["reach"] * foot == pytest.approx(80) and found["ft"]["coarse_cell"] * foot == pytest.approx(1)
    assert found["ft"]["ground_seen"] == pytest.approx(found["m"]["ground_seen"], abs=0.01)


def bounds(unit):
    return UTM[0], UTM[1], UTM[0] + SIDE / unit, UTM[1] + SIDE / unit


def test_the_same_bytes_after_an_interruption(tmp_path):
    needs("laspy"), needs("lazrs")
    surface = scene(hills, count=61)
    settings = MapSettings(("terrain", "points"), 1.0, tile=40, up="z")
    make_maps(MeshWithPhotos(surface, FRAME), settings, tmp_path / "whole")
    calls = interrupted_often(lambda: make_maps(MeshWithPhotos(surface, FRAME), settings, tmp_path / "parts"))
    assert calls > 10 and digests(tmp_path / "parts") == digests(tmp_path / "whole")


def test_lengths_in_metres_are_needed(tmp_path):
    surface = heightfield(lambda x, y: 0 * x, (0, 0), (5, 5), 10)
    with pytest.raises(BadInput, match="--metres-per-unit"):
        make_maps(MeshWithPhotos(surface, Frame(np.zeros(3), 0.01, None, None)), SETTINGS, tmp_path / "maps")
    assert not (tmp_path / "maps").exists()
    record = make_maps(
        MeshWithPhotos(surface, Frame(np.zeros(3), 0.01, None, None)), MapSettings((), 0.5, up="z"), tmp_path
    )
    assert record["files"] == ["dsm.tif"], "the surface model does not need them"


@pytest.mark.parametrize("wrong", [{"slope": 0.0}, {"height": -1.0}, {"building_width": float("nan")}])
def test_settings_that_make_no_sense(wrong):
    with pytest.raises(BadInput, match=f"--terrain.{next(iter(wrong)).replace('_', '-')}"):
        TerrainSettings(**wrong)


def test_a_membrane_keeps_planes_and_stays_between_its_borders():
    row, column = np.indices((130, 170)).astype(float)
    known = np.ones(row.shape, bool)
    known[30:95, 40:110] = False
    values = 0.1 * row - 0.07 * column
    assert np.abs(fill_smoothly(np.where(known, values, np.nan), known) - values).max() < 0.02
    bumps = 5 * np.sin(row / 9) * np.cos(column / 7)
    filled = fill_smoothly(bumps, known)
    assert np.array_equal(filled[known], bumps[known])
    assert filled.max() <= bumps[known].max() and filled.min() >= bumps[known].min()
    assert np.isnan(fill_smoothly(bumps, np.zeros(row.shape, bool))).all()
    part = between_cells(bumps, 3, np.arange(100, 140), np.arange(31, 90))
    assert np.array_equal(part, between_cells(bumps, 3, np.arange(390), np.arange(510))[100:140, 31:90])


def test_the_roughness_of_planes_is_none_and_of_noise_its_deviation():
    row, column = np.indices((60, 60)).astype(float)
    known = np.ones(row.shape, bool)
    assert roughness(500 + 0.4 * row - 0.7 * column, known).max() < 1e-5
    stripes = np.where((row + column) % 2 > 0, 1.0, -1.0)
    assert roughness(stripes, known).min() > 0.9
    known[20:30] = False
    assert np.isinf(roughness(row, known)[22:28]).all()
