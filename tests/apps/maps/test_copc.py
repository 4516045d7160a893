"""Cloud Optimized Point Clouds, read by laspy's reader of COPC and by copclib."""

import numpy as np
import pytest
from needs import needs

from surfkit.apps.maps import sorted_points
from surfkit.apps.maps.cloud import write_cloud
from surfkit.apps.maps.copc import KEY_BITS, SPAN, Node, Octree, nodes_of
from surfkit.apps.maps.geotiff import GeoTiffSettings, workshop
from surfkit.apps.maps.map_grid import map_crs
from surfkit.apps.maps.sorted_points import POINT, SortedPoints
from surfkit.scene.scene import Frame

from .shapes import UTM, grid_of, heightfield

laspy = needs("laspy")
needs("lazrs")
FRAME = Frame(np.array([*UTM, 0.0]), 0.01, 1.0, "EPSG:32633")
NAME = "points.copc.laz"


def hills(x, y):
    return 30 + 2 * np.sin(x / 7) + y / 10 - UTM[1] / 10


def paint(x, y):
    return np.stack([x % 255, y % 255, (x + y) % 255], 1)


def written(folder, spacing, color=paint, side=60.0, classify=None):
    surface = heightfield(hills, UTM, (UTM[0] + side, UTM[1] + side), 30, color)
    crs, _ = map_crs(FRAME)
    with workshop(folder, ()) as unfinished:
        sheet = GeoTiffSettings(grid_of(0.25, *UTM, UTM[0] + side, UTM[1] + side), crs, unfinished, folder)
        counts = write_cloud(surface, sheet, NAME, spacing, classify)
        assert not list(unfinished.glob("*.points"))
    return folder / NAME, counts


def places(points):
    """(n, 3) whole steps, sorted."""
    found = np.stack([points.X, points.Y, points.Z], 1)
    return found[np.lexsort(found.T)]


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    return written(tmp_path_factory.mktemp("copc"), 0.1, classify=lambda xyz: (2 + 4 * (xyz[:, 2] > 33)).astype("u1"))


def cells(points, info, level):
    """(n,) numbers of the cells of a level that points lie in."""
    low, size = info.center - info.halfsize, 2 * info.halfsize / SPAN / 2**level
    found = np.floor((np.stack([points.x, points.y, points.z], 1) - low + 1e-9) / size).astype(np.int64)
    return found @ [1, 10_000, 100_000_000]


def test_the_octree_has_the_points_of_the_file(cloud):
    path, counts = cloud
    whole = laspy.read(path)
    with laspy.CopcReader.open(path) as reader:
        assert np.array_equal(places(reader.query()), places(whole))
        info, levels = reader.copc_info, [reader.query(level=level) for level in range(4)]
    sizes = [len(points) for points in levels]
    assert sum(sizes) == len(whole) == sum(counts.values()) and sizes[0] < sizes[1] < sizes[2] and sizes[3] == 0
    assert whole.header.mins.tolist() == [*map(np.min, (whole.x, whole.y, whole.z))]
    assert whole.header.maxs.tolist() == [*map(np.max, (whole.x, whole.y, whole.z))]
    assert info.spacing == pytest.approx(2 * info.halfsize / SPAN)
    for level in (0, 1):
        shown = np.concatenate([cells(each, info, level) for each in levels[: level + 1]])
        assert len(shown) == len(np.unique(shown)) == len(np.unique(cells(whole, info, level))), "one in each cell"
    root = np.histogram2d(levels[0].x, levels[0].y, 6, ((UTM[0], UTM[0] + 60), (UTM[1], UTM[1] + 60)))[0]
    assert root.min() > 0.6 * root.mean(), "the root is spread over the whole area"


def test_colours_classes_and_the_reference_system(cloud):
    path, counts = cloud
    points = laspy.read(path)
    x, z = np.asarray(points.x), np.asarray(points.z)
    assert (str(points.header.version), points.header.point_format.id) == ("1.4", 7) and set(counts) == {"2", "6"}
    smooth = (x % 255 > 3) & (x % 255 < 252)  # within a triangle, not where colours start again
    assert np.abs(points.red / 257.0 - x % 255)[smooth].max() < 1.6 and not (points.red % 257).any()
    assert ((points.classification == 6) == (z > 33))[np.abs(z - 33) > 1e-3].all()
    assert set(points.return_number) == set(points.number_of_returns) == {1} == set(points.point_source_id)
    assert "UTM zone 33N" in points.header.parse_crs().to_wkt()
    assert points.header.number_of_points_by_return[0] == len(points)


def test_a_window_and_a_resolution(cloud):
    whole = laspy.read(cloud[0])
    low, high = np.array(UTM) + 10, np.array(UTM) + 25
    with laspy.CopcReader.open(cloud[0]) as reader:
        part = reader.query(bounds=laspy.copc.Bounds(low, high))
        coarse = reader.query(resolution=0.3)
    inside = ((whole.x >= low[0]) & (whole.x <= high[0]) & (whole.y >= low[1]) & (whole.y <= high[1])).sum()
    assert len(part) == inside > 10_000 and 10_000 < len(coarse) < len(whole)


def test_another_library_reads_nodes_where_they_are(cloud):
    copclib = needs("copclib")
    reader = copclib.FileReader(str(cloud[0]))
    info, nodes = reader.copc_config.copc_info, reader.GetAllNodes()
    assert sum(node.point_count for node in nodes) == sum(cloud[1].values())
    assert "UTM zone 33N" in reader.copc_config.wkt
    low = np.array([info.center_x, info.center_y, info.center_z]) - info.halfsize
    for node in nodes:
        key, points = node.key, reader.GetPoints(node)
        side = 2 * info.halfsize / 2**key.d
        corner = low + side * np.array([key.x, key.y, key.z])
        found = np.array([points.x, points.y, points.z]).T
        assert len(found) == node.point_count > 0
        assert (found >= corner - 1e-6).all() and (found < corner + side - 1e-6).all()


def test_the_same_bytes_whatever_is_in_memory(tmp_path, monkeypatch):
    surface = written(tmp_path / "whole", 0.15)[0].read_bytes()
    for name, value in (("RUN_POINTS", 9_000), ("MERGED_POINTS", 5_000), ("KEPT_KEYS", 50)):
        monkeypatch.setattr(sorted_points, name, value)
    monkeypatch.setattr("surfkit.apps.maps.cloud.BATCH_POINTS", 3_000)
    monkeypatch.setattr("surfkit.apps.maps.cloud.BATCH_TRIANGLES", 10**6)
    assert written(tmp_path / "parts", 0.15)[0].read_bytes() == surface


def test_small_clouds(tmp_path):
    path, counts = written(tmp_path / "few", 5.0, color=None)
    with laspy.CopcReader.open(path) as reader:
        assert len(reader.query(level=0)) == sum(counts.values()) > 100 and reader.header.point_format.id == 6
    path, counts = written(tmp_path / "none", 1000.0)
    assert counts == {} and len(laspy.read(path)) == 0
    with laspy.CopcReader.open(path) as reader:
        assert len(reader.query()) == 0


def test_sorted_points_are_those_of_one_sort(tmp_path, monkeypatch):
    for name, value in (("RUN_POINTS", 700), ("MERGED_POINTS", 300), ("KEPT_KEYS", 10)):
        monkeypatch.setattr(sorted_points, name, value)
    draw = np.random.default_rng(0)
    points = np.zeros(5000, POINT)
    points["place"] = draw.integers(-8, 8, (5000, 3))  # many alike
    points["color"][:, 0] = np.arange(5000) % 256
    spill = SortedPoints(tmp_path / "spill", np.full(3, -8), 16)
    for part in np.split(points, [1, 400, 1800, 1800, 4000]):
        spill.add(part)
    batches = list(spill.batches())
    cells = points["place"] + 8
    keys = sum(((cells[:, axis].astype(np.uint64) >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis))
               for bit in range(4) for axis in range(3)) << np.uint64(3 * (KEY_BITS - 4))  # fmt: skip
    assert len(batches) > 5 and np.array_equal(np.concatenate([each for each, _ in batches]), np.sort(keys))
    assert np.array_equal(np.concatenate([each for _, each in batches]), points[np.argsort(keys, kind="stable")])


def test_nodes_of_a_line():
    """Along a line, each level has as many points as cells, less those of the levels above."""
    octree = Octree(np.zeros(3, np.int64), 1 << KEY_BITS, 3)
    line = range(0, 1 << KEY_BITS, 1 << 10)  # 2048 places, which is 2 in each cell of level 3
    keys = np.array([sum((place >> bit & 1) << 3 * bit for bit in range(KEY_BITS)) for place in line], np.uint64)
    whole = [node for nodes in nodes_of(octree, [(keys, np.zeros(len(keys), POINT))]) for node in nodes]
    sizes = [sum(len(node.points) for node in whole if node.level == level) for level in range(4)]
    assert sizes == [SPAN, SPAN, 2 * SPAN, 12 * SPAN]
    assert sorted(node.key for node in whole) == [(level, x, 0, 0) for level in range(4) for x in range(2**level)]
    assert Node(3, 0b110_001_011, np.zeros(0, POINT)).key == (3, 0b011, 0b101, 0b100)
