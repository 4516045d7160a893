"""What is made of the surface model, against closed forms and other readers."""

import json

import numpy as np
import pyproj
import pytest
import torch
from needs import needs
from PIL import Image
from scipy.ndimage import gaussian_filter

from surfkit.apps.maps.cloud import sample_evenly, write_cloud
from surfkit.apps.maps.contours import contour_lines, even_interval
from surfkit.apps.maps.difference import write_difference
from surfkit.apps.maps.geotiff import GeoTiffSettings, workshop
from surfkit.apps.maps.hillshade import hillshade
from surfkit.apps.maps.joined_lines import joined
from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_grid import Window, map_crs, same_crs
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.texture.resolution import ground_sampling_distance
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

from .shapes import UTM, centres, gpkg_version, grid_of, heightfield, merged

rasterio = needs("rasterio")
FRAME = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, "EPSG:32633")


def cone(x, y):
    return 40 - np.hypot(x - UTM[0], y - UTM[1])


def test_contours_of_a_cone_are_circles_and_meet_where_tiles_do():
    grid = grid_of(0.25, UTM[0] - 20, UTM[1] - 20, UTM[0] + 20, UTM[1] + 20)
    heights = cone(*centres(grid))
    lines = contour_lines(heights, grid, Window(0, 0, grid.width, grid.height), 5.0)
    closed = {level: line for level, line in lines if (line[0] == line[-1]).all()}
    assert sorted(closed) == [25, 30, 35]
    for level, line in closed.items():
        radius = np.hypot(*(line - UTM).T)
        assert np.abs(radius - (40 - level)).max() < 0.01
        assert len(line) > 40 and np.isclose(
            np.hypot(*np.diff(line, axis=0).T).sum(), 2 * np.pi * (40 - level), rtol=1e-3
        )
    side = 70
    ends = []
    for part in grid.tiles(side):
        window = Window(
            part.left, part.top, min(side + 1, grid.width - part.left), min(side + 1, grid.height - part.top)
        )
        rows = slice(window.top, window.top + window.height)
        found = contour_lines(heights[rows, window.left : window.left + window.width], grid, window, 5.0)
        ends += [
            (level, *place) for level, line in found if (line[0] != line[-1]).any() for place in (line[0], line[-1])
        ]
    inner = [end for end in ends if np.hypot(end[1] - UTM[0], end[2] - UTM[1]) < 16]
    assert len(inner) > 10 and all(inner.count(end) == 2 for end in inner)


def whole_lines(lines):
    """Levels and lines, in an order and with beginnings of their own."""
    found = []
    for level, line in lines:
        if (line[0] == line[-1]).all():
            ring = line[:-1]
            line = np.roll(ring, -min(range(len(ring)), key=lambda at: tuple(ring[at])), 0)
        found.append((level, line.tobytes()))
    return sorted(found)


@pytest.mark.parametrize("side", [16, 23])
def test_lines_are_whole_where_tiles_cut_them(side):
    """Of rough ground with holes: the same lines as those of the whole map at once, from pieces in any tile."""
    draw = np.random.default_rng(3)
    grid = grid_of(1.0, 0, 0, 90, 70)
    heights = gaussian_filter(draw.normal(size=(70, 90)), 2.5) * 40
    heights[draw.random((70, 90)) < 0.01] = np.nan
    whole = contour_lines(heights, grid, Window(0, 0, 90, 70), 2.0)
    tiles = []
    for part in grid.tiles(side):
        window = Window(part.left, part.top, min(side + 1, 90 - part.left), min(side + 1, 70 - part.top))
        rows, columns = (slice(a, a + b) for a, b in ((window.top, window.height), (window.left, window.width)))
        tiles.append(contour_lines(heights[rows, columns], grid, window, 2.0))
    assert sum(map(len, tiles)) > 1.5 * len(whole)
    assert whole_lines(line for some in joined(len(tiles), tiles.__getitem__) for line in some) == whole_lines(whole)


def test_crumbs_are_left_out_and_counted(tmp_path):
    read = needs("pyogrio.raw").read
    subject = MeshWithPhotos(heightfield(cone, (UTM[0] - 15, UTM[1] - 15), (UTM[0] + 15, UTM[1] + 15), 40), FRAME)
    for shortest, least in (("auto", 7.5), (25.0, 25.0), (1_000.0, 1_000.0)):
        settings = MapSettings(("contours",), gsd=0.25, interval=5.0, shortest=shortest)
        record = make_maps(subject, settings, tmp_path)["contours"]
        levels = list(read(tmp_path / "contours.gpkg")[3][0])
        assert record["shortest"] == least and record["lines"] == len(levels)
        rings = [level for level in (30, 35) if 2 * np.pi * (40 - level) > least]
        assert [level for level in levels if level >= 30] == rings and 20 not in levels, "that has arcs in corners"
        assert record["too_short"] >= 4
    with pytest.raises(BadInput, match="--shortest -1: it is a length, so it must be 0 or more, or auto"):
        MapSettings(shortest=-1.0)


def test_levels_are_as_people_write_them():
    grid = grid_of(1.0, 0, 0, 30, 30)
    lines = contour_lines(centres(grid)[0] / 30, grid, Window(0, 0, 30, 30), 0.1)
    assert [level for level, _ in lines] == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]


def test_contours_end_at_holes_and_have_a_limit():
    grid = grid_of(1.0, 0, 0, 30, 30)
    slope = centres(grid)[0]
    slope[10:20] = np.nan
    lines = contour_lines(slope, grid, Window(0, 0, 30, 30), 10.0)
    assert sorted(level for level, _ in lines) == [10, 10, 20, 20]
    assert not any(((line[:, 1] > 11) & (line[:, 1] < 20)).any() for _, line in lines)
    with pytest.raises(BadInput, match="levels"):
        contour_lines(slope, grid, Window(0, 0, 30, 30), 1e-5)
    assert [even_interval(0, high) for high in (20, 21, 99, 1.1, 1000)] == [1, 2, 5, 0.1, 50]


def test_the_hillshade_of_planes_is_lamberts_law():
    rows, columns = np.indices((12, 12)) * 0.5
    for east, north in ((0, 0), (0.4, 0), (0, -0.7), (-0.5, 0.5)):
        heights = 7 + east * columns - north * rows
        normal = np.array([-east, -north, 1]) / np.sqrt(1 + east**2 + north**2)
        light = normal @ [-0.5, 0.5, np.sqrt(0.5)]
        assert (np.abs(hillshade(heights, 0.5).astype(float) - (1 + 254 * light)) <= 0.5 + 1e-9).all()
    heights[5, 5] = np.nan
    assert np.argwhere(hillshade(heights, 0.5) == 0).tolist() == [[i, j] for i in (3, 4, 5) for j in (3, 4, 5)]


def test_points_are_spread_evenly_whatever_the_batches(monkeypatch):
    surface = heightfield(lambda x, y: 0.5 * x, (0, 0), (8, 8), 30)
    area = 64 * np.sqrt(1.25)
    (points, colors), *rest = sample_evenly(surface, area / 5000)
    assert not rest and colors is None and len(points) == 5000
    assert np.abs(points[:, 2] - 0.5 * points[:, 0]).max() < 1e-12
    counts = np.histogram2d(points[:, 0], points[:, 1], 8, ((0, 8), (0, 8)))[0]
    assert np.abs(counts - 5000 / 64).max() < 25
    monkeypatch.setattr("surfkit.apps.maps.cloud.BATCH_TRIANGLES", 77)
    monkeypatch.setattr("surfkit.apps.maps.cloud.BATCH_POINTS", 5)
    again = np.concatenate([each for each, _ in sample_evenly(surface, area / 5000)])
    assert np.allclose(points, again, atol=1e-9)


def test_a_laz_file_is_read_back(tmp_path):
    laspy = needs("laspy")
    needs("lazrs")
    surface = heightfield(cone, UTM, (UTM[0] + 20, UTM[1] + 20), 30, lambda x, y: np.tile([[10, 200, 30]], (len(x), 1)))
    grid = grid_of(0.25, *UTM, UTM[0] + 20, UTM[1] + 10)
    crs, _ = map_crs(FRAME)
    with workshop(tmp_path, ()) as folder:
        count = write_cloud(surface, GeoTiffSettings(grid, crs, folder, tmp_path), "points.copc.laz", 0.2)["0"]
    with laspy.open(tmp_path / "points.copc.laz") as file:
        header, points = file.header, file.read()
    assert (str(header.version), header.point_format.id, header.are_points_compressed) == ("1.4", 7, True)
    assert header.global_encoding.wkt and len(points) == count
    text = next(vlr for vlr in header.vlrs if type(vlr).__name__ == "WktCoordinateSystemVlr").string
    assert "UTM zone 33N" in text and '"32633"' in text
    xyz = np.stack([points.x, points.y, points.z], 1)
    assert abs(count - 20 * 10 * np.sqrt(2) / 0.04) < 100
    assert np.abs(xyz[:, 2] - cone(xyz[:, 0], xyz[:, 1])).max() < 0.1
    assert xyz[:, 1].max() <= UTM[1] + 10 and xyz[:, 0].min() >= UTM[0] and header.scales.max() <= 0.001
    assert set(points.green) == {200 * 257} and set(points.point_source_id) == {1}


def rising(by):
    return lambda x, y: 5 + by * (x - UTM[0] - 10)


def test_volumes_of_cut_and_fill(tmp_path):
    """A plane turned about the middle of another one: two wedges of the same volume."""
    side, gsd = 20.0, 0.25
    here = heightfield(rising(0.3), UTM, (UTM[0] + side, UTM[1] + side))
    there = heightfield(rising(0.1), UTM, (UTM[0] + side, UTM[1] + side))
    settings = MapSettings((), gsd, tile=64)
    found = make_maps(MeshWithPhotos(here, FRAME), settings, tmp_path, there)["difference"]
    wedge = side * 0.2 * (side / 2) ** 2 / 2
    assert found["area"] == pytest.approx(side**2) and found["only_here"] == found["only_other"] == 0
    assert found["fill"] == pytest.approx(wedge, abs=side**2 * 0.2 * gsd / 8) and found["cut"] == pytest.approx(
        found["fill"]
    )
    assert found["median"] == pytest.approx(0, abs=0.03)
    assert found["median_absolute"] == pytest.approx(1, abs=0.03)
    assert found["percentile_90"] == pytest.approx(1.8, abs=0.03)
    with rasterio.open(tmp_path / "difference.tif") as file:
        x, _ = centres(grid_of(gsd, *UTM, UTM[0] + side, UTM[1] + side))
        assert np.abs(file.read(1) - 0.2 * (x - UTM[0] - 10)).max() < 1e-5 and file.crs.to_epsg() == 32633
    with Image.open(tmp_path / "difference.png") as picture:
        colors = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
    assert ((colors[:, 0] - colors[:, 2]) > 100).sum() > 1000 < ((colors[:, 2] - colors[:, 0]) > 100).sum()


def test_a_surface_does_not_differ_from_itself(tmp_path):
    here = heightfield(rising(0.3), UTM, (UTM[0] + 5, UTM[1] + 5))
    found = make_maps(MeshWithPhotos(here, FRAME), MapSettings((), 0.5), tmp_path, here)["difference"]
    assert [found[name] for name in ("fill", "cut", "median", "median_absolute", "percentile_90")] == [0] * 5


@pytest.mark.parametrize("heights", [[-4.0, 1.0, 2.0, 9.0], [-4.0, 1.0, 9.0], [3.0, -5.0], [2.0]])
def test_the_median_of_an_even_number_of_differences_is_a_mean(tmp_path, heights):
    grid = grid_of(1.0, *UTM, UTM[0] + len(heights), UTM[1] + 1)
    crs, _ = map_crs(FRAME)
    with workshop(tmp_path, ()) as folder:
        sheet = GeoTiffSettings(grid, crs, folder, tmp_path)
        for name, row in (("here.tif", heights), ("there.tif", np.zeros(len(heights)))):
            with sheet.raster(name, "heights") as file:
                file.write(np.array([row]), Window(0, 0, len(heights), 1), {})
        found = write_difference(sheet, (tmp_path / "here.tif", tmp_path / "there.tif"), "difference.tif", 64)
    assert found.median == pytest.approx(np.median(heights), abs=1e-4)
    assert found.median_absolute == pytest.approx(np.median(np.abs(heights)), abs=1e-4)
    assert found.percentile_90 == pytest.approx(np.percentile(np.abs(heights), 90), abs=1e-4)


def test_surfaces_apart_cannot_be_subtracted(tmp_path):
    west, east = UTM, (UTM[0] + 30, UTM[1])
    here, there = (heightfield(rising(0), at, (at[0] + 20, at[1] + 20)) for at in (west, east))
    with pytest.raises(BadInput, match="not in the same place"):
        make_maps(MeshWithPhotos(here, FRAME), MapSettings((), 0.5), tmp_path / "new", there)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    "bounds, said",
    [
        ((13.1, 52.3, 13.2, 52.4), "not in the same place"),
        ((UTM[0] + 30, UTM[1], UTM[0] + 40, UTM[1] + 9), "none of its"),
    ],
)
def test_maps_stay_when_the_next_ones_would_show_nothing(tmp_path, bounds, said):
    """Degrees where metres belong, a hole of the mesh: what an earlier call drew, of more products, is still there."""
    parts = [heightfield(rising(0), (UTM[0] + x, UTM[1]), (UTM[0] + x + 20, UTM[1] + 20)) for x in (0, 50)]
    here = merged(*parts)
    make_maps(MeshWithPhotos(here, FRAME), MapSettings(("hillshade", "contours"), 0.5), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(BadInput, match=said):
        make_maps(MeshWithPhotos(here, FRAME), MapSettings((), 0.5, bounds=bounds), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert {"dsm.tif", "hillshade.tif", "contours.gpkg", "maps.json"} <= before.keys()
    make_maps(MeshWithPhotos(here, FRAME), MapSettings((), 0.5), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"dsm.tif", "maps.json"}, "none of other maps stays"


@pytest.mark.parametrize(
    "crs, metres, unit",
    [
        ("EPSG:32633", 1.0, "m"),
        ("EPSG:2263+6360", 0.3048006096012192, "US ft"),
        ("EPSG:2263", 0.3048006096012192, "US ft"),
        ("EPSG:2222", 0.3048, "ft"),
        ("EPSG:2180", 1.0, "m"),
    ],
)
def test_lengths_are_called_as_their_system_does(tmp_path, crs, metres, unit):
    here = heightfield(rising(0), UTM, (UTM[0] + 20, UTM[1] + 20))
    frame = Frame(np.array([*UTM, 0.0]), 0.01, metres, crs)
    assert make_maps(MeshWithPhotos(here, frame), MapSettings((), 0.5), tmp_path)["unit"] == unit


@pytest.mark.parametrize(
    "crs, metres, said",
    [
        ("EPSG:2263+5703", 0.3048006096012192, "in units of US survey foot, heights in metre"),
        ("EPSG:2263", 1.0, "EPSG:2263 is in units of US survey foot"),
        ("EPSG:32633", 0.3048, "EPSG:32633 is in units of metre"),
        ("EPSG:5513", 1.0, "its axes point south and west"),
        ("EPSG:2048", 1.0, "its axes point west and south"),
        ("EPSG:3857", 1.0, r"lengths on the map are 1\.\d+ times .*[12]\.\d+ times"),
    ],
)
def test_a_system_that_would_make_volumes_wrong_is_refused(tmp_path, crs, metres, said):
    here = heightfield(rising(0), UTM, (UTM[0] + 20, UTM[1] + 20))
    with pytest.raises(BadInput, match=said):
        make_maps(
            MeshWithPhotos(here, Frame(np.array([*UTM, 0.0]), 0.01, metres, crs)), MapSettings((), 0.5), tmp_path / "m"
        )
    assert not (tmp_path / "m").exists()


def test_lengths_that_a_map_stretches_a_little_are_told_of(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("surfkit.apps.maps.map_grid.emit", told.append)
    place = (2_000_000.0, 2_000_000.0)  # 64 degrees north
    for crs, at in (("EPSG:3035", (4_321_000.0, 3_210_000.0)), ("EPSG:3995", place)):
        map_crs(Frame(np.array([*at, 0.0]), 0.01, 1.0, crs))
    longer = float(told[0].text.split("are ")[1].split(" times")[0])
    lon, lat = pyproj.Transformer.from_crs("EPSG:3995", "EPSG:4326", always_xy=True).transform(*place)
    scale = pyproj.Proj("EPSG:3995").get_factors(lon, lat).areal_scale ** 0.5
    assert len(told) == 1 and longer == pytest.approx(scale, abs=2e-3)


def test_a_coordinate_reference_system_is_the_same_however_it_is_spelt():
    text = rasterio.crs.CRS.from_epsg(32633).to_wkt(version="WKT1_ESRI")
    place = "+proj=topocentric +ellps=WGS84 +lat_0=52.5 +lon_0=16.0 +h_0={}".format
    assert same_crs("EPSG:32633", text) and same_crs("EPSG:32633", "epsg:32633") and same_crs(None, None)
    assert not same_crs("EPSG:32633", "EPSG:32632") and not same_crs("EPSG:32633", None)
    assert same_crs(place(80.0), place(80.0)) and not same_crs(place(80.0), place(90.0))
    assert not same_crs("EPSG:32633", "some system")


def test_all_products_of_a_hill(tmp_path):
    read = needs("pyogrio.raw").read
    needs("laspy"), needs("lazrs")

    def color(x, y):
        return np.tile([[90, 80, 70]], (len(x), 1))

    surface = heightfield(cone, (UTM[0] - 15, UTM[1] - 15), (UTM[0] + 15, UTM[1] + 15), 40, color)
    settings = MapSettings(gsd=0.25, interval=5.0, shortest=0.0, tile=50)
    record = make_maps(MeshWithPhotos(surface, FRAME), settings, tmp_path)
    assert json.loads((tmp_path / "maps.json").read_text()) == record
    assert record["files"] == ["dsm.tif", "orthophoto.tif", "hillshade.tif", "contours.gpkg", "points.copc.laz"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*record["files"], "maps.json"])
    assert record["covered"] == 1 and record["gsd"] == 0.25 and record["size"] == [120, 120]
    meta, _, shapes, (levels,) = read(tmp_path / "contours.gpkg")
    assert (
        "32633" in meta["crs"] and list(meta["fields"]) == ["elevation"] and len(levels) == record["contours"]["lines"]
    )
    assert gpkg_version(tmp_path / "contours.gpkg") == 10200
    assert set(levels) == {20, 25, 30, 35}
    lengths = dict.fromkeys(levels, 0.0)
    for level, shape in zip(levels, shapes, strict=True):
        places = np.frombuffer(shape[9:], "<f8").reshape(-1, 2)
        assert np.abs(np.hypot(*(places - UTM).T) - (40 - level)).max() < 0.2, "a mesh of steps of 0.8 m"
        lengths[level] += np.hypot(*np.diff(places, axis=0).T).sum()
    for level in (30, 35):
        assert list(levels).count(level) == 1, "one line, whatever the tiles"
        assert lengths[level] == pytest.approx(2 * np.pi * (40 - level), rel=0.01), "tiles leave no gaps"
    with rasterio.open(tmp_path / "hillshade.tif") as file:
        shade = file.read(1)
    assert shade[[0, -1]].max() == 0 and shade[1:-1, 1:-1].min() > 0
    assert shade[20:40, 20:40].mean() > shade[80:100, 80:100].mean() + 100, "light from the north-west"


def test_level_ground_and_heights_in_millions(tmp_path):
    read = needs("pyogrio.raw").read
    laspy = needs("laspy")
    flat = heightfield(lambda x, y: 0 * x + 6_371_000.125, UTM, (UTM[0] + 5, UTM[1] + 5))
    record = make_maps(MeshWithPhotos(flat, FRAME), MapSettings(("contours", "points"), 0.1), tmp_path)
    assert record["contours"]["lines"] == 0 and len(read(tmp_path / "contours.gpkg")[2]) == 0
    assert np.abs(laspy.read(tmp_path / "points.copc.laz").z - 6_371_000.125).max() < 1e-3
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert file.dtypes == ("float64",) and (file.read(1) == 6_371_000.125).all()


def view_from(height, focal, place=(0.0, 0.0)):
    """A camera in the local frame that looks down from so many units of the input above UTM."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    centre = np.array([*place, height]) * FRAME.scale
    pose[:3, 3] = -pose[:3, :3] @ centre
    return View("", Camera(torch.from_numpy(pose), focal, focal, 50, 50, 100, 100), None)


def test_the_ground_sampling_distance_is_that_of_a_pixel():
    flat = heightfield(lambda x, y: 0 * x, (UTM[0] - 50, UTM[1] - 50), (UTM[0] + 50, UTM[1] + 50))
    views = [view_from(80, 400), view_from(100, 400), view_from(120, 400), view_from(5, 400, (1e4, 0))]
    assert ground_sampling_distance(flat, views, FRAME) == 0.25
    with pytest.raises(BadInput, match="--gsd auto"):
        ground_sampling_distance(flat, views[3:], FRAME)


def test_colours_that_are_not_there_are_said(tmp_path, capsys):
    surface = heightfield(cone, UTM, (UTM[0] + 5, UTM[1] + 5))
    record = make_maps(
        MeshWithPhotos(SurfaceFile("a.ply", surface.rows, surface.faces), FRAME),
        MapSettings(("orthophoto",), 1.0),
        tmp_path,
    )
    assert record["files"] == ["dsm.tif"]


@pytest.mark.parametrize(
    "wrong", [{"gsd": 0.0}, {"tile": 3}, {"interval": float("nan")}, {"bounds": (0, 0, 0, 5)}, {"spacing": -1.0}]
)
def test_settings_that_make_no_sense(wrong):
    with pytest.raises(BadInput, match=f"--{next(iter(wrong))}"):
        MapSettings(**wrong)
