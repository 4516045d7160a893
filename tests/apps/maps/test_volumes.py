"""Volumes within polygons, against closed forms."""

import csv
import json
from itertools import pairwise

import numpy as np
import pyproj
import pytest
from needs import needs

from surfkit.apps.maps.cell_shares import outline_pieces
from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_grid import Window
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.core.check import BadInput
from surfkit.scene.scene import Frame

from .shapes import UTM, gpkg_version, grid_of, heightfield

needs("rasterio")
pyogrio, raw = needs("pyogrio"), needs("pyogrio.raw")
shapely = needs("shapely")
FRAME = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, "EPSG:32633")
MIDDLE = np.array([UTM[0] + 10, UTM[1] + 10])
CRS_2008 = {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}}


def circle(radius, about=(0.0, 0.0), corners=90):
    turns = np.arange(corners) * 2 * np.pi / corners
    return MIDDLE + about + radius * np.stack([np.cos(turns), np.sin(turns)], 1)


def box(low, high, degrees=0.0):
    (west, south), (east, north) = low, high
    turn = np.radians(degrees)
    corners = np.array([[west, south], [east, south], [east, north], [west, north]], float)
    return MIDDLE + corners @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]


def closed(ring):
    return np.concatenate([ring, ring[:1]])


def geojson(path, *shapes, kind="Polygon", **head):
    """A file of items: each a list of rings, or of lists of rings."""

    def listed(part):
        return closed(part).tolist() if isinstance(part, np.ndarray) else [listed(each) for each in part]

    items = [
        {"type": "Feature", "properties": {"name": name}, "geometry": {"type": kind, "coordinates": listed(shape)}}
        for name, shape in zip("abc", shapes, strict=False)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": items, **(head or CRS_2008)}))
    return path


def heap(x, y):
    """A frustum 3 high on a slope: 8 below, 4 above in radius; the slope rises by 0.2."""
    ground = 50 + 0.2 * (x - UTM[0])
    return ground + 3 * ((8 - np.hypot(x - MIDDLE[0], y - MIDDLE[1])) / 4).clip(0, 1)


HEAP = np.pi * 3 / 3 * (8**2 + 8 * 4 + 4**2)


def surface(height, count=201):
    return heightfield(height, UTM, (UTM[0] + 20, UTM[1] + 20), count)


def measured(tmp_path, path, height, other=None, frame=FRAME, gsd=0.1, **settings):
    told = MapSettings((), gsd, volume=path, **settings)
    here = height if hasattr(height, "rows") else surface(height)
    record = make_maps(MeshWithPhotos(here, frame), told, tmp_path / "maps", other)
    return record["volumes"]["polygons"]


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0])
def test_shares_of_cells_are_exact(degrees):
    """Of a turned box with a hole, whose shares are found by 30 x 30 places in each cell too."""
    outline, hole = closed(box((-4, -3), (4.3, 3), degrees)), closed(box((-1, -1), (2, 1.5), degrees + 20))[::-1]
    grid = grid_of(0.5, *(MIDDLE - 8), *(MIDDLE + 8))
    pieces = outline_pieces([outline, hole], grid)
    shares = pieces.shares(Window(0, 0, grid.width, grid.height))
    assert shares.sum() * 0.25 == pytest.approx(shapely.Polygon(outline, [hole]).area, rel=1e-12)
    fine = 30
    columns, rows = np.meshgrid(*((np.arange(size * fine) + 0.5) / fine for size in (grid.width, grid.height)))
    places = np.stack([grid.west + columns, grid.north - rows], -1) * grid.gsd
    inside = np.zeros(columns.shape, bool)
    for ring in (outline, hole):
        for (ax, ay), (bx, by) in pairwise(ring):
            if ay != by:
                over = (ay > places[..., 1]) != (by > places[..., 1])
                inside ^= over & (places[..., 0] < ax + (places[..., 1] - ay) / (by - ay) * (bx - ax))
    counted = inside.reshape(grid.height, fine, grid.width, fine).mean((1, 3))
    assert np.abs(counted - shares).max() < 0.06
    left, top = 13, 7
    part = pieces.shares(Window(left, top, 11, 9))
    assert np.allclose(part, shares[top : top + 9, left : left + 11], rtol=0, atol=1e-12)


def test_a_polygon_that_the_map_cuts_counts_what_is_on_it():
    grid = grid_of(0.5, *MIDDLE, *(MIDDLE + 8))
    cell = Window(0, 0, grid.width, grid.height)
    whole = outline_pieces([closed(box((-1e6, -1e6), (1e6, 1e6), 30.0))], grid).shares(cell)
    assert (whole == 1).all()
    half = outline_pieces([closed(box((-100, -100), (100, 4)))], grid).shares(cell)
    assert half.sum() * 0.25 == pytest.approx((grid.bounds[2] - grid.bounds[0]) * (MIDDLE[1] + 4 - grid.bounds[1]))


@pytest.mark.parametrize("base", ["plane", "triangulated"])
def test_a_frustum_on_a_slope(tmp_path, base):
    found = measured(tmp_path, geojson(tmp_path / "a.geojson", [circle(8.5)]), heap, base=base)[0]
    assert found["net"] == pytest.approx(HEAP, rel=2e-3) and found["cut"] == pytest.approx(0, abs=0.05)
    assert found["highest"] == pytest.approx(3, abs=0.02) and found["without_surface"] == 0
    assert found["mean_height"] == pytest.approx(found["net"] / found["area"])
    assert (found["base_lowest"], found["base_highest"]) == pytest.approx((50.3, 53.7), abs=0.01)
    assert (found["base_error"] is not None) == (base == "plane")
    if base == "plane":
        assert found["base_error"] == pytest.approx(found["base_residual"] * found["area"]) and found["base_error"] < 1


@pytest.mark.parametrize("base, level", [("lowest", 50.3), (51.0, 51.0)])
def test_a_level_base(tmp_path, base, level):
    """Of the slope alone, the volume above is a wedge of a disk: its mean is the height at its middle."""
    found = measured(tmp_path, geojson(tmp_path / "a.geojson", [circle(8.5)]), heap, base=base)[0]
    area = shapely.Polygon(circle(8.5)).area
    assert found["net"] == pytest.approx(HEAP + (52 - level) * area, rel=2e-3)
    assert found["base_lowest"] == found["base_highest"] == pytest.approx(level, abs=0.01)
    assert found["cut"] == pytest.approx(0, abs=0.01) if base == "lowest" else found["cut"] > 1


def test_a_triangulated_base_follows_an_outline_that_bends_inwards(tmp_path):
    """A ridge between the arms of a U; it has no volume above what lies between the heights along the outline. Any
    triangle from arm to arm would cut through it."""

    def ridge(x, y):
        return 100 - 0.5 * np.abs(x - MIDDLE[0])

    corners = [[-8, -8], [8, -8], [8, 8], [5, 8], [5, -5], [-5, -5], [-5, 8], [-8, 8]]
    path = geojson(tmp_path / "a.geojson", [MIDDLE + np.array(corners, float)])
    mesh = heightfield(ridge, (MIDDLE[0] - 10, UTM[1]), (UTM[0] + 20, UTM[1] + 20), 101)
    bent, plane = (measured(tmp_path, path, mesh, base=base)[0] for base in ("triangulated", "plane"))
    assert bent["area"] == pytest.approx(16 * 3 + 2 * 3 * 13)
    assert max(bent["fill"], bent["cut"]) < 2e-3 * bent["area"] < 0.1 * plane["fill"]
    assert plane["base_residual"] > 0.5 and plane["base_error"] > plane["fill"] > 20


def test_small_turned_polygons_of_some_ten_cells(tmp_path):
    """Cells count by their share: the volume of a slab is its area times its height, to the last digits. That of a
    slope is off by less than 0.5 %, where cells that count by their centres are off by up to 10 %."""
    shapes = [[box((-1.7, -1.1), (1.6, 1.3), degrees)] for degrees in (0, 31, 77)]
    path = geojson(tmp_path / "a.geojson", *shapes)
    for found in measured(tmp_path, path, lambda x, y: 53 + 0 * x, gsd=0.7, base=50.0):
        assert found["net"] == pytest.approx(3 * 3.3 * 2.4, rel=1e-6)
    shapes = [[box((-1.6, -1.2), (1.6, 1.2), degrees)] for degrees in (0, 31, 77)]
    path = geojson(tmp_path / "a.geojson", *shapes)
    for found in measured(tmp_path, path, lambda x, y: 53 + 0.5 * (x - MIDDLE[0]), gsd=0.7, base=50.0):
        assert found["net"] == pytest.approx(3 * 3.2 * 2.4, rel=5e-3)


def test_a_hole_and_parts_apart(tmp_path):
    """A slab 2 high: parts are one item, a hole is left out; holes may be drawn in any direction."""
    hole = box((-6, -6), (-4, -4))
    shapes = [[[box((-8, -8), (-2, -2), 0), hole]], [[box((-8, -8), (-2, -2), 0)[::-1], hole[::-1]], [circle(1.0)]]]
    path = geojson(tmp_path / "a.geojson", *shapes, kind="MultiPolygon")
    one, two = measured(tmp_path, path, lambda x, y: 52 + 0 * x, base=50.0)
    assert one["net"] == pytest.approx(2 * (36 - 4), rel=1e-6)
    assert two["net"] - one["net"] == pytest.approx(2 * shapely.Polygon(circle(1.0)).area, rel=1e-6)


@pytest.mark.parametrize("name", ["a.geojson", "a.gpkg", "a.shp", "degrees.geojson", "feet.gpkg"])
def test_all_formats_and_systems_give_the_same(tmp_path, name):
    """GeoJSON is in degrees by RFC 7946; a GeoPackage may be in another zone."""
    ring = closed(circle(8.5))
    system = {"degrees.geojson": "EPSG:4326", "feet.gpkg": "EPSG:32632"}.get(name, "EPSG:32633")
    moved = np.stack(pyproj.Transformer.from_crs("EPSG:32633", system, always_xy=True).transform(*ring.T), 1)
    path = tmp_path / name
    if name.endswith(".geojson"):
        geojson(path, [moved[:-1]], **({"name": "x"} if system == "EPSG:4326" else CRS_2008))
    else:
        shape = b"\x01" + np.array([3, 1, len(moved)], "<u4").tobytes() + moved.astype("<f8").tobytes()
        driver = {"gpkg": "GPKG", "shp": "ESRI Shapefile"}[name[-4:].strip(".")]
        names = np.array(["a"], object)
        raw.write(path, np.array([shape], object), [names], ["name"], driver=driver, geometry_type="Polygon",
                  crs=system)  # fmt: skip
    found = measured(tmp_path, path, heap, gsd=0.2)[0]
    reference = measured(tmp_path, geojson(tmp_path / "reference.geojson", [circle(8.5)]), heap, gsd=0.2)[0]
    assert found.pop("name") == reference.pop("name") == "a" and found.pop("base") == reference.pop("base")
    numbers = [[value for value in each.values() if value is not None] for each in (found, reference)]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-5, abs=1e-3)


def test_volumes_do_not_depend_on_tiles(tmp_path):
    path = geojson(tmp_path / "a.geojson", [circle(8.5)], [box((-3, -2), (5, 4), 20)])
    here, there = surface(heap, 61), surface(lambda x, y: heap(x, y) - 0.1, 61)
    found = [measured(tmp_path, path, here, there, gsd=0.2, tile=tile) for tile in (2048, 37)]
    assert found[0] == found[1]


def test_two_dates_and_the_least_detectable_difference(tmp_path):
    """The middle was raised by 1 in a box and cut by 0.5 in another; between them it moved by 0.03."""

    def before(x, y):
        return 50 + 0 * x

    def after(x, y):
        east, north = x - MIDDLE[0], y - MIDDLE[1]
        return 50.03 + 0.97 * ((east > 2) & (east < 6) & (north < 0)) - 0.53 * ((east < -2) & (north > 3))

    path = geojson(tmp_path / "a.geojson", [box((-8, -8), (8, 8))])
    there = surface(before)
    small = measured(tmp_path, path, surface(after, 401), there)[0]
    found = measured(tmp_path, path, surface(after, 401), there, least_difference=0.05)[0]
    fill, cut = 4 * 8 * 1.0, 6 * 5 * 0.5
    assert found["fill_since"] == pytest.approx(fill, rel=0.02) and found["cut_since"] == pytest.approx(cut, rel=0.02)
    assert found["changed"] == pytest.approx(4 * 8 + 6 * 5, rel=0.03) and found["compared"] == pytest.approx(256)
    assert found["net_since"] == found["fill_since"] - found["cut_since"]
    assert small["fill_since"] - found["fill_since"] == pytest.approx(0.03 * (256 - 62), rel=0.05)
    record = json.loads((tmp_path / "maps/maps.json").read_text())["difference"]
    assert record["least_difference"] == 0.05 and record["unchanged"] == pytest.approx(400 - 4 * 10 - 8 * 7, rel=0.02)


def test_what_has_no_surface_is_told_and_counts_as_nothing(tmp_path, warned):
    path = geojson(tmp_path / "a.geojson", [box((-2, 6), (2, 14))])
    found = measured(tmp_path, path, lambda x, y: 52 + 0 * x, base="lowest")[0]
    assert found["without_surface"] == pytest.approx(0.5, abs=0.01) and found["net"] == pytest.approx(0, abs=1e-3)
    assert found["outline_with_surface"] == pytest.approx(0.5, abs=0.01)
    assert "has no surface" in " ".join(warned)


def test_the_table_and_the_layer_say_what_the_record_says(tmp_path):
    path = geojson(tmp_path / "a.geojson", [circle(8.5)], [box((-3, -2), (5, 4), 20)])
    found = measured(tmp_path, path, heap)
    with (tmp_path / "maps/volumes.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    meta, _, shapes, fields = raw.read(tmp_path / "maps/volumes.gpkg")
    assert meta["crs"] == "EPSG:32633" and len(shapes) == 2 and meta["geometry_type"] == "MultiPolygon"
    layer = dict(zip(meta["fields"], fields, strict=True))
    for at, each in enumerate(found):
        assert rows[at]["name"] == layer["name"][at] == each["name"] and rows[at]["base_error"] == ""
        assert float(rows[at]["net"]) == layer["net"][at] == each["net"] and np.isnan(layer["base_error"][at])
    assert gpkg_version(tmp_path / "maps/volumes.gpkg") == 10200
    known = pyogrio.read_info(tmp_path / "maps/volumes.csv")
    texts = {name for name, kind in zip(known["fields"], known["dtypes"], strict=True) if kind == "object"}
    assert texts == {"name", "base"}, "all others are numbers to QGIS"
    again = measured(tmp_path, tmp_path / "maps/volumes.gpkg", heap)
    assert [each["net"] for each in again] == pytest.approx([each["net"] for each in found])


BOW = MIDDLE + np.array([[-3, -3], [3, 3], [3, -3], [-3, 3]], float)
LINE = {"type": "LineString", "coordinates": [[0.0, 0.0], [1.0, 1.0]]}


@pytest.mark.parametrize(
    "shapes, said",
    [
        ([[box((100, 100), (110, 110))]], "it lies within .* on the map, and the map within .*move it"),
        ([[box((-3, -3), (3, 3))[:, ::-1]]], "coordinates swapped it lies on the map"),
        ([[BOW]], "its area is in doubt: self-intersection near 451244 5873221"),
        ([[circle(5), circle(1, (20, 0))]], "hole lies outside shell near 451265 5873221"),
        ([[circle(5), circle(2, (5, 0))]], "self-intersection near 4512"),
        ([[circle(5), circle(3), circle(1)]], "holes are nested near"),
        ([[MIDDLE + np.array([[0.0, 0.0], [1, 1], [2, 2]])]], "self-intersection|too few points"),
    ],
)  # fmt: skip
def test_unsound_polygons_are_refused_before_anything_is_drawn(tmp_path, shapes, said):
    path = geojson(tmp_path / "a.geojson", [circle(2)], *shapes)
    with pytest.raises(BadInput, match=said) as caught:
        measured(tmp_path, path, heap)
    assert "a.geojson: polygon 2 ('b'): " in str(caught.value) and "\n" not in str(caught.value)
    assert not (tmp_path / "maps").exists()


@pytest.mark.parametrize(
    "text, said",
    [
        ('{"type": "FeatureCollection", "features": []}', "no polygon in it"),
        (json.dumps(LINE), "it is a LineString; only polygons have an area"),
        ('{"type": "Polygon", "coordinates": []}', "it is empty|no polygon in it"),
        ("hello", "no GeoJSON, GPKG or SHP file that GDAL reads"),
    ],
)
def test_files_without_polygons(tmp_path, text, said):
    (tmp_path / "a.geojson").write_text(text)
    with pytest.raises(BadInput, match=said):
        measured(tmp_path, tmp_path / "a.geojson", heap)


def test_a_missing_file_and_settings_without_it(tmp_path):
    with pytest.raises(BadInput, match="there is no such file"):
        measured(tmp_path, tmp_path / "none.gpkg", heap)
    with pytest.raises(BadInput, match="--volume FILE"):
        MapSettings(base="plane")


def test_degrees_swapped_are_noticed(tmp_path):
    to_degrees = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(*circle(5).T)
    path = geojson(tmp_path / "a.geojson", [np.stack([lat, lon], 1)], name="x")
    with pytest.raises(BadInput, match="write longitude .easting. first"):
        measured(tmp_path, path, heap)


def test_a_map_that_is_not_georeferenced_takes_files_without_a_system(tmp_path, warned):
    frame = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, None)
    degrees = geojson(tmp_path / "a.geojson", [circle(5)], name="x")
    with pytest.raises(BadInput, match='WGS 84.*the map is not georeferenced.*"crs": null'):
        measured(tmp_path, degrees, lambda x, y: 52 + 0 * x, frame=frame, up="z")
    path = geojson(tmp_path / "b.geojson", [circle(5)], crs=None)
    found = measured(tmp_path, path, lambda x, y: 52 + 0 * x, frame=frame, base=50.0, up="z")[0]
    assert found["net"] == pytest.approx(2 * found["area"], rel=1e-6)
    assert "taken as those of the map" in " ".join(warned)
