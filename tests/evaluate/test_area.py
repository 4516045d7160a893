"""Comparisons within the polygons of a file, against comparisons of what was cut by hand."""

from dataclasses import replace

import numpy as np
import pytest
from needs import needs
from polygon_files import write_polygons

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry import comparison
from surfkit.evaluate.geometry.comparison import Comparison, compare
from surfkit.evaluate.geometry.measure_geometry import measure_geometry
from surfkit.evaluate.geometry.scores import shares
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.evaluate.geometry.transform import apply, write_transform
from surfkit.io.splats.ply import write_points
from surfkit.scene.scene import Frame
from surfkit.testing.synthetic import Flight, photograph

shapely, trimesh = needs("shapely"), needs("trimesh")
EAST, NORTH = 451_234.0, 5_873_211.0
TRIANGLE = np.array([[2.0, 1.0], [9.0, 3.0], [4.0, 8.0]])
SHAPE = shapely.Polygon(TRIANGLE + [EAST, NORTH], [[(EAST + x, NORTH + y) for x, y in [(4, 3), (6, 4), (4, 5)]]])
STILL = Comparison(crop="none", align="none", draws=1, tau=0.15)


def surface(points, faces=None):
    return SurfaceFile("given.ply", np.asarray(points, float) + [EAST, NORTH, 0], faces)


def strewn(seed, noise, count=20_000):
    draw = np.random.default_rng(seed)
    return np.column_stack([draw.uniform(0, 10, (count, 2)), draw.normal(0, noise, count)])


def inside(points, shape=SHAPE):
    return shapely.contains_xy(shape, *(points[:, :2] + [EAST, NORTH]).T)


def f1(outcome):
    return shares(outcome.draws[0].distances, outcome.tau)


@pytest.fixture
def unplaced(monkeypatch):
    """Files that are not there name no system; the photographs do."""
    monkeypatch.setattr(comparison, "ALIGNMENTS", ("none",))
    return Frame(np.array([EAST, NORTH, 0.0]), 0.1, 1.0, "EPSG:32633")


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326"])
def test_clouds_within_an_area_as_clouds_cut_by_hand(tmp_path, unplaced, crs):
    """One side has a gap within the area, and much else around it."""
    ours, theirs = strewn(1, 0.12), strewn(2, 0.01)
    ours = ours[(ours[:, 0] > 3.5) | (ours[:, 1] > 8)]
    path = write_polygons(tmp_path / "site.gpkg", SHAPE, crs=crs)
    found = compare(surface(ours), surface(theirs), replace(STILL, area=path), frame=unplaced)
    by_hand = compare(surface(ours[inside(ours)]), surface(theirs[inside(theirs)]), STILL)
    assert f1(found) == pytest.approx(f1(by_hand), abs=1e-3 if crs == "EPSG:4326" else 0)
    whole = f1(compare(surface(ours), surface(theirs), STILL))
    assert abs(f1(found)[1] - whole[1]) > 0.05 and f1(found)[1] < 0.9


def test_meshes_within_an_area_as_meshes_cut_by_planes(tmp_path, unplaced):
    """A ball on a plane, and a ball moved by 0.1; cut along the edges of a triangle by trimesh."""
    ground = trimesh.creation.box((12, 12, 0.02), trimesh.transformations.translation_matrix([5, 5, 0]))
    ground = ground.submesh([ground.face_normals[:, 2] > 0.5], append=True).subdivide_to_size(0.5)
    balls = [trimesh.creation.icosphere(4, 2.0).apply_translation(at) for at in ((5, 4, 0.0), (5.2, 4, 0.1))]
    whole = [trimesh.util.concatenate([ground, ball]) for ball in balls]

    def cut(mesh):
        for start, end in zip(TRIANGLE, np.roll(TRIANGLE, -1, 0), strict=True):
            along = end - start
            mesh = mesh.slice_plane([*start, 0], [-along[1], along[0], 0])
        return mesh

    parts = [cut(mesh) for mesh in whole]
    sides = [[surface(each.vertices, np.asarray(each.faces)) for each in pair] for pair in (whole, parts)]
    path = write_polygons(tmp_path / "site.gpkg", shapely.Polygon(TRIANGLE + [EAST, NORTH]))
    all_of_it = replace(STILL, samples=300_000)
    alike = replace(STILL, samples=round(300_000 * parts[0].area / whole[0].area))
    found, by_hand = compare(*sides[0], replace(all_of_it, area=path), frame=unplaced), compare(*sides[1], alike)
    assert f1(found) == pytest.approx(f1(by_hand), abs=0.01)
    assert f1(found)[0] < 0.97 * f1(compare(*sides[0], all_of_it))[0]


def test_an_area_stays_in_the_coordinates_of_the_data_set(tmp_path, unplaced):
    """The truth lies in another frame, turned, twice as large: the polygons turn with it."""
    angle = np.radians(40)
    matrix = np.eye(4)
    turn = trimesh.transformations.rotation_matrix(angle, [1, 2, 3])[:3, :3]
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, 2 * turn @ [-EAST, -NORTH, 0] + [3, 4, 5]
    write_transform(tmp_path / "trans.txt", matrix)
    ours, theirs = strewn(1, 0.12), strewn(2, 0.01)
    path = write_polygons(tmp_path / "site.gpkg", SHAPE)
    moved = SurfaceFile("truth.ply", apply(matrix, surface(theirs).vertices()))
    here = compare(surface(ours), surface(theirs), replace(STILL, area=path), frame=unplaced)
    settings = replace(STILL, area=path, tau=0.3, transform=tmp_path / "trans.txt")
    views = photograph(Flight(views=8, width=16, height=12, points=20, test_every=0)).scene.train
    there = compare(surface(ours), moved, settings, views, unplaced)
    assert f1(there) == pytest.approx(f1(here), abs=0.01)
    for points in (there.draws[0].truth, there.draws[0].reconstruction):
        back = apply(np.linalg.inv(matrix), points)
        assert shapely.contains_xy(SHAPE.buffer(1e-6), *back[:, :2].T).all()
        assert np.ptp(back, axis=0)[:2] == pytest.approx(np.ptp(TRIANGLE, axis=0), abs=0.3)


def test_the_crop_volume_and_the_area_hold_both(tmp_path):
    """Of a data set without a coordinate reference system; what is written lies in both."""
    scene = photograph(Flight(views=8, width=64, height=48, points=50, test_every=0)).scene
    x, y = np.meshgrid(np.arange(-9, 9, 0.15), np.arange(-9, 9, 0.15))
    ground = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    for name, points in (("truth", ground), ("ours", ground[ground[:, 0] < 3] + [0, 0, 0.01])):
        write_points(tmp_path / f"{name}.ply", points, np.zeros((len(points), 3), np.uint8))
    shape = shapely.Polygon([(-8, -8), (6, -6), (0, 5)], [[(-3, -4), (0, -4), (-2, -2)]])
    path = write_polygons(tmp_path / "site.shp", shape, crs=None)
    settings = Comparison(draws=2, align="rigid", visible=0.5, area=path, classes=False)
    files = tmp_path / "ours.ply", tmp_path / "truth.ply"
    found = measure_geometry(files, settings, tmp_path / "geometry", scene.train, scene.frame)["geometry"]
    points = read_surface(tmp_path / "geometry/recall.ply").vertices()
    assert len(points) > 500 and shapely.contains_xy(shape.buffer(0.02), *points[:, :2].T).all()
    assert found["area"] == {"file": str(path), "polygons": 1, "area": pytest.approx(shape.area)}
    assert found["crop"]["from"] == "auto" and found["outside"]["beside"] > 0.5
    missed = (points[:, 0] > 3.1).mean()
    assert 0.02 < missed and found["recall"] == pytest.approx(1 - missed, abs=0.05) and found["precision"] > 0.99


def test_areas_that_are_refused(tmp_path, unplaced):
    ours, theirs = surface(strewn(1, 0.1, 2_000)), surface(strewn(2, 0.1, 2_000))
    far = write_polygons(tmp_path / "far.gpkg", shapely.box(EAST + 100, NORTH, EAST + 110, NORTH + 10))
    with pytest.raises(BadInput, match=f"^--area {far}: polygon 1 .*on the reconstruction, and the reconstruction wi"):
        compare(ours, theirs, replace(STILL, area=far), frame=unplaced)
    half = surface(strewn(2, 0.1, 2_000) * [0.2, 1, 1])
    path = write_polygons(tmp_path / "site.gpkg", shapely.box(EAST + 5, NORTH, EAST + 9, NORTH + 9))
    with pytest.raises(BadInput, match=f"given.ply: 0 points within --area {path}; 10 or more"):
        compare(ours, half, replace(STILL, area=path), frame=unplaced)
    with pytest.raises(BadInput, match="the reconstruction is not georeferenced"):
        compare(ours, theirs, replace(STILL, area=path), frame=replace(unplaced, crs=None))


def test_a_file_that_names_its_system_needs_no_photographs(tmp_path, unplaced):
    """A cloud of surfkit says it in its header."""
    ours, theirs = strewn(1, 0.12), strewn(2, 0.01)
    for name, points in (("ours", ours), ("truth", theirs)):
        near = points[:, :3].astype(np.float32)
        write_points(tmp_path / f"{name}.ply", near, np.zeros((len(points), 3), np.uint8))
        head, end, body = (tmp_path / f"{name}.ply").read_bytes().partition(b"end_header\n")
        told = f"comment Generated by surfkit\ncomment offset: {EAST} {NORTH} 0\ncomment crs: EPSG:32633\n"
        first, _, rest = head.partition(b"element")
        (tmp_path / f"{name}.ply").write_bytes(first + told.encode() + b"element" + rest + end + body)
    path = write_polygons(tmp_path / "site.geojson", SHAPE, crs="EPSG:4326")
    settings = replace(STILL, area=path, classes=False)
    files = tmp_path / "ours.ply", tmp_path / "truth.ply"
    found = measure_geometry(files, settings, tmp_path / "geometry")["geometry"]
    by_hand = f1(compare(surface(ours[inside(ours)]), surface(theirs[inside(theirs)]), STILL))
    assert (found["precision"], found["recall"], found["f1"]) == pytest.approx(by_hand, abs=2e-3)
