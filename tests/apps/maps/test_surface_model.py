"""The surface model against analytic heights, and files of it against other readers."""

import numpy as np
import pytest
from needs import needs

from surfkit.apps.maps.geotiff import GeoTiffSettings, workshop
from surfkit.apps.maps.map_grid import MapGrid, map_crs
from surfkit.apps.maps.owned_files import PRODUCT_FILES
from surfkit.apps.maps.rasters import BANDS, NO_COUNT, NODATA, system_of_file
from surfkit.apps.maps.surface_model import draw_surface, needs_double
from surfkit.apps.maps.zbuffer import NO_TRIANGLE
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.scene.earth import geocentric, to_ecef
from surfkit.scene.scene import Frame
from surfkit.scene.up_direction import map_axes

from .shapes import UTM, box, centres, drawn, grid_of, heightfield, merged, surface_of

rasterio = needs("rasterio")


def test_a_plane_far_from_the_origin_is_exact_and_has_no_crack():
    def height(x, y):
        return 50 + 0.3 * (x - UTM[0]) - 0.2 * (y - UTM[1])

    surface = heightfield(height, UTM, (UTM[0] + 20, UTM[1] + 20))
    found, face, x, y = drawn(surface, grid_of(0.1, *UTM, UTM[0] + 20, UTM[1] + 20))
    assert (face != NO_TRIANGLE).all() and found.shape == (200, 200)
    assert np.abs(found - height(x, y)).max() < 1e-8


def test_centres_on_edges_and_corners_belong_to_the_surface():
    """Vertices at centres of cells, and edges through them."""
    surface = surface_of([[0.5, 0.5, 1], [4.5, 0.5, 1], [4.5, 4.5, 1], [0.5, 4.5, 1]], [[0, 1, 2], [2, 0, 3]])
    found, *_ = drawn(surface, grid_of(1.0, 0, 0, 5, 5))
    assert (found == 1).all()


def test_a_pyramid_and_a_sphere():
    def pyramid(x, y):
        return 3 - np.maximum(np.abs(x), np.abs(y))

    corners = [[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0], [0, 0, 3]]
    found, _, x, y = drawn(surface_of(corners, [[i, (i + 1) % 4, 4] for i in range(4)]), grid_of(0.25, -3, -3, 3, 3))
    assert np.abs(found - pyramid(x, y)).max() < 1e-12

    steps = 200
    phi, theta = np.meshgrid(np.linspace(0, 2 * np.pi, steps), np.linspace(0, np.pi, steps), indexing="ij")
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    number = np.arange(steps * steps).reshape(steps, steps)
    quads = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack([quads[i] for i in tri], -1).reshape(-1, 3) for tri in ((0, 1, 2), (0, 2, 3))])
    found, face, x, y = drawn(surface_of(ball.reshape(-1, 3), faces), grid_of(0.05, -1, -1, 1, 1))
    inside = np.hypot(x, y) < 0.9
    assert np.abs(found - np.sqrt(np.maximum(0, 1 - x**2 - y**2)))[inside].max() < 5e-4, "the upper side"
    assert (face[np.hypot(x, y) > 1] == NO_TRIANGLE).all()


def test_what_hangs_over_counts():
    surface = merged(box((0, 0, 0), (10, 10, 1)), box((4, 4, 5), (8, 9, 6)), box((5, 5, 2), (6, 6, 3)))
    found, _, x, y = drawn(surface, grid_of(0.5, -1, -1, 11, 11))
    slab = (x > 0) & (x < 10) & (y > 0) & (y < 10)
    roof = (x > 4) & (x < 8) & (y > 4) & (y < 9)
    assert (found == np.where(roof, 6, np.where(slab, 1, -np.inf))).all()


def hills(x, y):
    return 100 + 4 * np.sin((x - UTM[0]) / 5) * np.cos((y - UTM[1]) / 7)


@pytest.fixture(scope="module")
def surface():
    def color(x, y):
        share = np.stack([(x - UTM[0]) / 60, (y - UTM[1]) / 60, 0 * x + 0.5], 1)
        return (255 * share).round()

    return heightfield(hills, UTM, (UTM[0] + 60, UTM[1] + 60), 60, color)


def written(surface, out, side, gsd=0.25, frame=None):
    grid = grid_of(gsd, UTM[0] - 3, UTM[1] - 3, UTM[0] + 63, UTM[1] + 63)
    crs, _ = map_crs(frame or Frame(np.zeros(3), 1.0, 1.0, "EPSG:32633"))
    with workshop(out, ("dsm.tif",)) as folder:
        sheet = GeoTiffSettings(grid, crs, folder, out)
        facts = draw_surface(surface, sheet, side, "dsm.tif", sheet.raster("orthophoto.tif", "colors"))
    return grid, facts


def test_geotiffs_are_read_back(surface, tmp_path):
    grid, facts = written(surface, tmp_path, 2048, gsd=0.1)
    x, y = centres(grid)
    inside = (x > UTM[0]) & (x < UTM[0] + 60) & (y > UTM[1]) & (y < UTM[1] + 60)
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert file.crs.to_epsg() == 32633 and file.nodata == NODATA and file.dtypes == ("float32",)
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG" and file.overviews(1) == [2]
        assert file.compression.name == "deflate" and file.block_shapes == [(512, 512)]
        heights = file.read(1)
        assert np.abs(heights[inside] - hills(x, y)[inside]).max() < 0.1, "a mesh of steps of 1 m"
        assert ((heights != NODATA) == inside).all() and facts.covered == inside.sum()
        east, north = UTM[0] + 12.345, UTM[1] + 23.456
        at = file.index(east, north)
        assert abs(x[at] - east) <= 0.05 and abs(y[at] - north) <= 0.05
        thin = file.read(1, out_shape=(file.height // 4, file.width // 4), masked=True)
        assert 95 < thin.min() and thin.max() < 105, "overviews leave out what is nodata"
    with rasterio.open(tmp_path / "orthophoto.tif") as file:
        colors = file.read()
        assert [each.name for each in file.colorinterp] == ["red", "green", "blue", "alpha"]
        assert ((colors[3] == 255) == inside).all() and not colors[:3, ~inside].any()
        assert np.abs(colors[0] - 255 * (x - UTM[0]) / 60)[inside].max() < 1.01
        assert np.abs(colors[1] - 255 * (y - UTM[1]) / 60)[inside].max() < 1.01
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dsm.tif", "orthophoto.tif"]


@pytest.mark.parametrize(
    ("crs", "metres", "unit"),
    [
        ("EPSG:32633", 1.0, "metre"),
        ("EPSG:2263", 0.3048006096012192, "US survey foot"),
        (None, 1.0, "metre"),
        (None, 0.3048, None),
        (None, None, None),
    ],
)
def test_bands_say_what_they_have_and_in_which_unit(surface, tmp_path, crs, metres, unit):
    written(surface, tmp_path, 2048, frame=Frame(np.zeros(3), 1.0, metres, crs))
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert (file.descriptions, file.units) == (("height of the surface",), (unit,))


def test_only_heights_name_their_datum(surface, tmp_path):
    """GDAL takes bands for heights in its unit, and gdalwarp shifts them by the geoid, where a file names it."""
    written(surface, tmp_path, 2048, frame=Frame(np.zeros(3), 1.0, 1.0, "EPSG:32633+5773"))
    with rasterio.open(tmp_path / "dsm.tif") as file, rasterio.open(tmp_path / "orthophoto.tif") as photo:
        assert "5773" in file.crs.to_wkt() and photo.crs.to_epsg() == 32633
        assert file.units == ("metre",) and photo.units == (None,) * 4
        assert (file.transform, file.shape) == (photo.transform, photo.shape)
    compound = "EPSG:2263+6360"
    assert system_of_file(rasterio.CRS.from_user_input(compound), has_heights=False).to_epsg() == 2263
    shift = "+proj=tmerc +lon_0=9 +x_0=3500000 +ellps=bessel +towgs84=598,74,418,0,0,0,0 +units=m +vunits=m"
    plan = system_of_file(rasterio.CRS.from_user_input(f"{shift} +geoidgrids=a.gtx"), has_heights=False).to_wkt()
    assert plan.startswith("PROJCS") and "TOWGS84[598" in plan, "else it would lie 100 m from the heights"


@pytest.mark.parametrize(("metres", "factor"), [(1.0, 'metre",1'), (2.0, "2"), (None, None)])
def test_a_unit_of_unknown_length_is_no_metre(surface, tmp_path, metres, factor):
    written(surface, tmp_path, 2048, frame=Frame(np.zeros(3), 1.0, metres))
    for name in ("dsm.tif", "orthophoto.tif"):
        with rasterio.open(tmp_path / name) as file:
            assert (file.crs is None) if factor is None else factor in file.crs.to_wkt()
            assert file.transform.a == 0.25


def test_counts_are_whole_in_overviews_too(tmp_path):
    grid = grid_of(1.0, *UTM, UTM[0] + 700, UTM[1] + 700)
    counts = np.where(np.indices((700, 700)).sum(0) % 2, 3.0, 0.0)
    counts[:100], counts[100:110] = NODATA, 1e6
    crs, _ = map_crs(Frame(np.zeros(3), 1.0, 1.0, "EPSG:32633"))
    with workshop(tmp_path, ("rays.tif",)) as folder:
        with GeoTiffSettings(grid, crs, folder, tmp_path).raster("rays.tif", "counts") as raster:
            raster.write(counts, next(grid.tiles(1000)), {})
    with rasterio.open(tmp_path / "rays.tif") as file:
        assert file.dtypes == ("uint16",) and file.nodata == NO_COUNT and file.overviews(1)
        found = file.read(1, masked=True)
        assert found.mask[:100].all() and not found.mask[100:].any() and (found[100:110] == NO_COUNT - 1).all()
        assert (found[110:] == counts[110:]).all()
    with rasterio.open(tmp_path / "rays.tif", overview_level=0) as file:
        assert set(np.unique(file.read(1)[60:])) <= {0, 3}, "no mean of counts is one"


def test_bands_are_named_after_the_files_that_exist():
    assert set(BANDS) == {name for name in PRODUCT_FILES.values() if name.endswith(".tif")} - {"orthophoto.tif"}


def test_tiles_change_no_bit(surface, tmp_path, monkeypatch):
    written(surface, tmp_path / "whole", 2048)
    monkeypatch.setattr("surfkit.apps.maps.bins.BATCH_TRIANGLES", 1000)
    monkeypatch.setattr("surfkit.apps.maps.zbuffer.BATCH_TRIANGLE_CELLS", 500)
    monkeypatch.setattr("surfkit.apps.maps.surface_model.BATCH_CELLS", 300)
    written(surface, tmp_path / "tiled", 37)
    for name in ("dsm.tif", "orthophoto.tif"):
        with rasterio.open(tmp_path / "whole" / name) as whole, rasterio.open(tmp_path / "tiled" / name) as tiled:
            assert (whole.read() == tiled.read()).all() and whole.read().any()


def test_a_triangle_larger_than_memory_for_it(monkeypatch):
    surface = surface_of([[-500, -500, 1], [700, -500, 1], [-500, 700, 7]], [[0, 1, 2]])
    whole, *_ = drawn(surface, grid_of(1.0, 0, 0, 90, 90))
    monkeypatch.setattr("surfkit.apps.maps.zbuffer.BATCH_TRIANGLE_CELLS", 1000)
    pieces, *_ = drawn(surface, grid_of(1.0, 0, 0, 90, 90))
    assert (whole == pieces).all() and np.isfinite(whole).all()


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (1, 0, 0), (0.6, 0, 0.8)])
def test_axes_for_another_direction_that_is_up(up):
    turn = map_axes(np.array(up, float))
    assert np.allclose(turn @ turn.T, np.eye(3)) and np.isclose(np.linalg.det(turn), 1)
    assert np.allclose(turn @ up, [0, 0, 1])
    flat = surface_of(np.array([[0, 0, 5], [8, 0, 5], [0, 8, 5]]) @ turn, [[0, 1, 2]])
    found, face, *_ = drawn(flat, MapGrid.around(turn, 1.0, (0, 0, 4, 4)))
    assert np.allclose(found, 5)
    assert (map_axes(np.array([0.0, 0.0, 1.0])) == np.eye(3)).all()


def test_coordinate_reference_systems():
    def of(crs, metres=1.0):
        return map_crs(Frame(np.zeros(3), 1.0, metres, crs))

    assert of("EPSG:25832")[0].to_epsg() == 25832
    crs, told = of(None)
    assert told == "local coordinates, not georeferenced; unit: 1 m" and not crs.is_projected
    assert of(None, None)[1].endswith("unit: of unknown length")
    place, told = of("+proj=topocentric +ellps=WGS84 +lat_0=52.5 +lon_0=16.9 +h_0=80")
    assert "ortho" in told and place.is_projected
    for wrong in ("EPSG:4326", "EPSG:4978", "no such thing"):
        with pytest.raises(BadInput, match="coordinate reference system"):
            of(wrong)


def test_topocentric_coordinates_are_where_the_orthographic_projection_has_them():
    """GDAL places a point of the map where the geocentric formulas place the point of the frame."""
    text = "+proj=topocentric +ellps=WGS84 +lat_0=52.5 +lon_0=16.9 +h_0=0"
    crs, _ = map_crs(Frame(np.zeros(3), 1.0, 1.0, text))
    xyz = np.array([[800.0, -600.0, 100.0]])
    (east,), (north,) = needs("rasterio.warp").transform(crs, "EPSG:4326", xyz[:, 0], xyz[:, 1])
    earth = to_ecef(text, xyz)
    height = np.linalg.norm(earth) - np.linalg.norm(geocentric(north, east, 0.0))
    assert np.linalg.norm(geocentric(north, east, height) - earth) < 0.02


def test_heights_in_millions_have_64_bits():
    grid = grid_of(0.1, 0, 0, 5, 5)
    flat = np.array([[0, 0, 0], [5, 0, 0], [0, 5, 0]], float)
    assert not needs_double(surface_of(flat + [0, 0, 4000], [[0, 1, 2]]), grid)
    assert needs_double(surface_of(flat + [0, 0, 6.3e6], [[0, 1, 2]]), grid)


def test_a_map_of_too_many_cells_is_refused():
    with pytest.raises(BadInput, match="too many for one map"):
        grid_of(0.1, 0, 0, 1e6, 1e6)
    assert grid_of(0.1, 0, 0, 10_000, 10_000).width == 100_000


def test_meshes_that_are_empty_or_not_finite(tmp_path):
    def ply(vertices, faces):
        path = tmp_path / "mesh.ply"
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
        header += [f"property double {axis}" for axis in "xyz"]
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
        rows = np.zeros(len(faces), [("n", "u1"), ("at", "<i4", 3)])
        rows["n"], rows["at"] = 3, np.asarray(faces).reshape(-1, 3)
        path.write_bytes("\n".join(header).encode() + np.asarray(vertices, "<f8").tobytes() + rows.tobytes())
        return path

    with pytest.raises(BadInput, match="without faces"):
        read_surface(ply(np.zeros((3, 3)), []))
    with pytest.raises(BadInput, match="finite"):
        read_surface(ply(np.full((3, 3), np.nan), [[0, 1, 2]]))
    corners = [[0, 0, 1], [4, 0, 1], [0, 4, 1], [np.nan, 0, 0]]
    surface = read_surface(ply(corners, [[0, 1, 2], [1, 2, 3]]))
    found, face, x, y = drawn(surface, grid_of(0.5, 0, 0, 4, 4))
    assert ((found == 1) == (x + y <= 4)).all()
