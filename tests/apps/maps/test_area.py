"""Maps within the polygons of a file, against what shapely and rasterio say of the same polygons."""

import json

import numpy as np
import pytest
from needs import needs
from polygon_files import write_polygons

from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.core.check import BadInput
from surfkit.scene.scene import Frame

from .shapes import UTM, heightfield

rasterio, features = needs("rasterio"), needs("rasterio.features")
raw, shapely = needs("pyogrio.raw"), needs("shapely")
FRAME = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, "EPSG:32633")
GSD = 0.1


def at(*corners):
    return [(UTM[0] + x, UTM[1] + y) for x, y in corners]


def box(west, south, east, north):
    return shapely.box(*at((west, south))[0], *at((east, north))[0])


TRIANGLE = shapely.Polygon(at((3, 2), (17, 5), (6, 15)))
HOLED = shapely.Polygon(at((2, 2), (18, 2), (18, 18), (2, 18)), [at((6, 6), (12, 6), (12, 11), (6, 11))])
APART = shapely.MultiPolygon([box(1, 1, 4, 4), box(10, 9, 13, 15)])


def slope(x, y):
    return 50 + 0.3 * (x - UTM[0]) + 0.1 * np.sin(y)


def surface(height=slope, count=61):
    return heightfield(height, UTM, (UTM[0] + 20, UTM[1] + 20), count, lambda x, y: np.full((len(x), 3), 90))


def mapped(out, area, products=(), frame=FRAME, height=slope, **settings):
    told = MapSettings(products, GSD, area=area, **settings)
    return make_maps(MeshWithPhotos(surface(height), frame), told, out)


def masks(path, shape):
    """(H, W) bool each: cells with data, and those whose centre lies in the shape, by GDAL."""
    with rasterio.open(path) as file:
        known = file.dataset_mask() > 0
        return known, features.geometry_mask([shape], known.shape, file.transform, invert=True)


@pytest.mark.parametrize("shape", [TRIANGLE, HOLED, APART])
@pytest.mark.parametrize("tile", [2048, 37])
def test_cells_outside_of_the_area_have_no_data(tmp_path, shape, tile):
    area = write_polygons(tmp_path / "site.gpkg", shape)
    record = mapped(tmp_path / "maps", area, ("orthophoto", "hillshade", "contours", "points"), interval=0.5,
                    shortest=0.0, spacing=0.2, tile=tile)  # fmt: skip
    for name in ("dsm.tif", "orthophoto.tif"):
        known, inside = masks(tmp_path / "maps" / name, shape)
        assert (known == inside).mean() > 1 - 1e-4 and 0.1 < known.mean() < 0.9  # GDAL differs on centres on an edge
    known, inside = masks(tmp_path / "maps/hillshade.tif", shape.buffer(-0.3))
    assert not (known & ~masks(tmp_path / "maps/dsm.tif", shape)[0]).any() and known[inside].all()
    assert np.allclose(record["bounds"], shape.bounds, rtol=0, atol=GSD) and record["covered"] == pytest.approx(
        1, abs=0.01
    )
    assert record["area"] == {"file": str(area), "polygons": 1, "area": pytest.approx(shape.area, rel=1e-9)}
    assert json.loads((tmp_path / "maps/maps.json").read_text())["area"] == record["area"]
    lines = shapely.from_wkb(raw.read(tmp_path / "maps/contours.gpkg")[2])
    assert len(lines) > 3 and shapely.covers(shape.buffer(GSD), lines).all()
    assert shapely.length(lines).sum() == pytest.approx(shape.area * 0.3 / 0.5, rel=0.1)
    cloud = needs("laspy").read(tmp_path / "maps/points.copc.laz")
    assert shapely.covers(shape.buffer(1e-3), shapely.points(cloud.x, cloud.y)).all()
    assert len(cloud) == pytest.approx(shape.area * 1.045 / 0.2**2, rel=0.03)


def test_a_slab_cut_by_a_triangle(tmp_path):
    """Its volume is the area of the triangle times the height of the slab, within the cells at the border."""
    area = write_polygons(tmp_path / "site.gpkg", TRIANGLE)
    volume = write_polygons(tmp_path / "all.gpkg", box(0, 0, 20, 20))
    record = mapped(tmp_path / "maps", area, height=lambda x, y: 53 + 0 * x, volume=volume, base=50.0)
    found = record["volumes"]["polygons"][0]
    assert TRIANGLE.area == pytest.approx(0.5 * abs(14 * 13 - 3 * 3))
    assert found["net"] == pytest.approx(3 * TRIANGLE.area, rel=2e-3)
    assert found["without_surface"] == pytest.approx(1 - TRIANGLE.area / 400, abs=1e-3)


@pytest.mark.parametrize("name, crs", [("a.geojson", "EPSG:4326"), ("a.gpkg", "EPSG:32632"), ("a.shp", "EPSG:25833")])
def test_a_file_in_another_system(tmp_path, name, crs):
    area = write_polygons(tmp_path / name, TRIANGLE, crs=crs)
    record = mapped(tmp_path / "maps", area)
    known, inside = masks(tmp_path / "maps/dsm.tif", TRIANGLE)
    assert (known == inside).mean() > 0.999 and record["area"]["area"] == pytest.approx(TRIANGLE.area, rel=1e-5)


def test_polygons_of_a_file_count_once_where_they_overlap(tmp_path):
    area = write_polygons(tmp_path / "site.gpkg", TRIANGLE, HOLED)
    both = TRIANGLE.union(HOLED)
    found = mapped(tmp_path / "maps", area)["area"]
    assert (
        found["polygons"] == 2 and found["area"] == pytest.approx(both.area) and both.area < HOLED.area + TRIANGLE.area
    )


def test_terrain_and_differences_end_at_the_area(tmp_path):
    area = write_polygons(tmp_path / "site.gpkg", HOLED)
    told = MapSettings(("terrain",), GSD, area=area)
    make_maps(MeshWithPhotos(surface(), FRAME), told, tmp_path / "maps", surface(lambda x, y: slope(x, y) - 0.5))
    dsm, _ = masks(tmp_path / "maps/dsm.tif", HOLED)
    for name in ("dtm", "ndsm", "ground-distance", "dsm-other", "difference"):
        assert (masks(tmp_path / f"maps/{name}.tif", HOLED)[0] == dsm).all(), name


def test_bounds_and_area_hold_both(tmp_path):
    area = write_polygons(tmp_path / "site.gpkg", HOLED)
    west, south, east, north = bounds = (*at((0, 0))[0], *at((9, 9))[0])
    record = mapped(tmp_path / "maps", area, bounds=bounds)
    assert record["bounds"] == pytest.approx([west + 2, south + 2, east, north])
    assert record["covered"] == pytest.approx(1, abs=0.01)


def test_volumes_that_the_area_cuts_off_are_told_and_those_outside_refused(tmp_path, warned):
    area = write_polygons(tmp_path / "site.gpkg", HOLED)
    inside = write_polygons(tmp_path / "inside.gpkg", box(3, 3, 5, 5))
    mapped(tmp_path / "maps", area, volume=inside)
    assert "outside" not in " ".join(warned)
    mapped(tmp_path / "maps", area, volume=write_polygons(tmp_path / "half.gpkg", box(4, 7, 8, 9)))
    assert "50.0% of it, 4 m², lies outside the polygons of --area" in " ".join(warned)
    with pytest.raises(BadInput, match="--volume: polygon 'a' lies outside the polygons of --area"):
        mapped(tmp_path / "none", area, volume=write_polygons(tmp_path / "hole.gpkg", box(7, 7, 9, 9)))
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    "shape, said",
    [
        (box(100, 100, 110, 110), "it lies within .* on the map, and the map within .*move it"),
        (shapely.transform(TRIANGLE, lambda at: at[:, ::-1]), "coordinates swapped it lies on the map"),
        (shapely.LineString(at((1, 1), (5, 5))), "it is a LineString; only polygons have an area"),
        (shapely.Polygon(at((3, 3), (9, 9), (9, 3), (3, 9))), "not valid, .* self-intersection near 451240 5873217"),
    ],
)  # fmt: skip
def test_areas_that_are_refused(tmp_path, shape, said):
    path = write_polygons(tmp_path / "site.gpkg", shape)
    with pytest.raises(BadInput, match=said) as caught:
        mapped(tmp_path / "maps", path)
    assert str(caught.value).startswith(f"--area {path}: polygon 1 ('a'): ") and not (tmp_path / "maps").exists()


def test_a_folder_and_a_file_without_a_system(tmp_path, warned):
    with pytest.raises(BadInput, match="^--area .*: it is a folder; name the GeoJSON, GPKG or SHP file"):
        mapped(tmp_path / "maps", tmp_path)
    local = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, None)
    with pytest.raises(BadInput, match="^--area .*the map is not georeferenced"):
        mapped(tmp_path / "maps", write_polygons(tmp_path / "a.gpkg", TRIANGLE), frame=local, up="z")
    path = write_polygons(tmp_path / "b.shp", TRIANGLE, crs=None)
    assert mapped(tmp_path / "maps", path, frame=local, up="z")["area"]["area"] == pytest.approx(TRIANGLE.area)
    assert "taken as those of the map" in " ".join(warned)
