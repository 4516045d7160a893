"""Meshes and clouds from files of every kind, and what is wrong with bad ones."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from needs import needs
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry import surface_file as surface
from surfkit.evaluate.geometry.file_transform import same_plan
from surfkit.evaluate.geometry.height_systems import HeightSystem
from surfkit.evaluate.geometry.las import read_las
from surfkit.evaluate.geometry.sampling import face_areas
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface, rounding, system_of
from surfkit.evaluate.geometry.top_surface import highest
from surfkit.io.splats.ply import write_points

trimesh = needs("trimesh")
BOX = trimesh.creation.box((1, 2, 3))


def binary_ply(path, vertices, faces, kind="<f4", corners=3):
    """A mesh as the project writes it: uchar-counted int lists, colours between."""
    word = {"<f4": "float", "<f8": "double"}[kind]
    rows = np.zeros(len(vertices), [(axis, kind) for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    for i, axis in enumerate("xyz"):
        rows[axis] = np.asarray(vertices)[:, i]
    lists = np.zeros(len(faces), [("n", "u1"), ("v", "<i4", (corners,))])
    lists["n"], lists["v"] = corners, np.asarray(faces).reshape(-1, corners)
    properties = [f"property {word} {axis}" for axis in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties]
    head += [f"element face {len(lists)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(head).encode() + rows.tobytes() + lists.tobytes())
    return path


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
def test_a_binary_mesh_is_mapped_as_trimesh_reads_it(tmp_path, kind):
    path = binary_ply(tmp_path / "mesh.ply", BOX.vertices + 1e6 * (kind == "<f8"), BOX.faces, kind)
    found, other = read_surface(path), trimesh.load(path, process=False)
    assert np.array_equal(found.vertices(), other.vertices) and np.array_equal(found.faces, other.faces)
    assert isinstance(found.rows, np.memmap)


@pytest.mark.parametrize("suffix", ["obj", "stl", "off", "glb"])
def test_other_meshes(tmp_path, suffix):
    path = tmp_path / f"mesh.{suffix}"
    BOX.export(path)
    found = read_surface(path)
    corners = found.vertices()[found.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(22, rel=1e-5)


def test_text_files(tmp_path):
    (tmp_path / "mesh.ply").write_bytes(trimesh.exchange.ply.export_ply(BOX, encoding="ascii"))
    assert np.allclose(read_surface(tmp_path / "mesh.ply").vertices(), BOX.vertices)
    (tmp_path / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "1 2 3\n4 5 6\n"
    )
    cloud = read_surface(tmp_path / "cloud.ply")
    assert cloud.faces is None and cloud.vertices().tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_text_keeps_all_digits_of_coordinates(tmp_path):
    corners = np.array([[512345.12, 5412345.34, 100.5], [512346.12, 5412345.34, 100.5], [512345.12, 5412346.34, 100.5]])
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float32 y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path = tmp_path / "text.ply"
    path.write_text(head + "\n".join(" ".join(f"{it:.2f}" for it in row) for row in corners) + "\n3 0 1 2\n")
    assert np.array_equal(read_surface(path).vertices(), corners)
    assert rounding(read_surface(path)) == 0
    short = SurfaceFile(path, corners.astype(np.float32), np.array([[0, 1, 2]]))
    assert rounding(short) == 0.5 and rounding(replace(short, rows=short.rows.astype(float))) == 0.5
    offset = replace(short, rows=(corners - corners[0]).astype(np.float32), offset=tuple(corners[0]))
    assert rounding(offset) < 1e-6, "what the file leaves out is not rounded"


def test_a_cloud_comes_in_blocks(tmp_path, monkeypatch, warned):
    xyz = np.random.default_rng(0).normal(size=(1000, 3))
    xyz[[3, 700]] = np.nan
    write_points(tmp_path / "cloud.ply", xyz, np.zeros((1000, 3), np.uint8))
    monkeypatch.setattr(surface, "BLOCK_POINTS", 300)
    blocks = list(read_surface(tmp_path / "cloud.ply").blocks())
    assert [len(block) for block in blocks] == [299, 300, 299, 100]
    assert np.array_equal(np.concatenate(blocks), xyz[np.isfinite(xyz).all(1)])
    assert warned == [f"{tmp_path / 'cloud.ply'}: 2 of 1000 points are not finite and are left out"]


def test_faces_at_vertices_that_are_not_finite_go(tmp_path, warned):
    vertices = BOX.vertices.copy()
    vertices[0] = np.inf
    found = read_surface(binary_ply(tmp_path / "mesh.ply", vertices, BOX.faces))
    assert len(found.faces) == (BOX.faces != 0).all(1).sum() and len(warned) == 1


def cloud_with_lists(path, xyz, counted="uchar", first=(), cut=None):
    """A cloud whose points are in i % 4 views each, with a weight for each view, as OpenMVS writes them."""
    lists = [f"property list {counted} uint views", "property float error", "property list uchar double weights"]
    axes = [f"property float {axis}" for axis in "xyz"]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *first, *axes, *lists, "end_header"]
    wide = {"uchar": "B", "int": "i", "float": "f"}[counted]
    rows = [
        struct.pack(f"<3f{wide}{i % 4}IfB{i % 4}d", *point, i % 4, *range(i % 4), 0.5, i % 4, *[1.0] * (i % 4))
        for i, point in enumerate(xyz)
    ]
    path.write_bytes(("\n".join(head) + "\n").encode() + b"".join(rows)[:cut])
    return path


@pytest.mark.parametrize("counted", ["uchar", "int"])
def test_points_with_lists(tmp_path, counted):
    xyz = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    found = read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, counted))
    assert found.faces is None and np.array_equal(found.vertices(), xyz)


def test_bad_points_with_lists(tmp_path):
    xyz = np.ones((6, 3), np.float32)
    for cut in (-1, -9, -10):  # within the last list, before its count, within the number before that
        with pytest.raises(BadInput, match="cut off after 5 of 6 vertices"):
            read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, cut=cut))
    with pytest.raises(BadInput, match="counts its numbers with float"):
        read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, "float"))
    for line, message in {
        "property list uchar int a": "'property list uchar int a'",
        "property half a": "cannot read 'property half a' of a vertex",
        "property float x": "or one twice: x, x",
    }.items():
        with pytest.raises(BadInput, match=message):
            read_surface(cloud_with_lists(tmp_path / "cloud.ply", xyz, first=[line]))
    path = cloud_with_lists(tmp_path / "cloud.ply", xyz)
    whole = path.read_bytes()
    for line in (b"property list uchar double", b"property list half double weights", b"property list"):
        path.write_bytes(whole.replace(b"property list uchar double weights", line))
        with pytest.raises(BadInput, match="'property list.* of a vertex"):
            read_surface(path)
    path.write_bytes(whole.replace(b"end_header", b"comment"))
    with pytest.raises(BadInput, match="the PLY header does not end"):
        read_surface(path)
    path.write_bytes(whole.replace(b"element vertex 6", b"element camera 6"))
    with pytest.raises(BadInput, match="first .* 'element vertex N'"):
        read_surface(path)


@pytest.mark.parametrize(
    ("name", "vertices", "faces", "corners", "message"),
    [
        ("without", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [], 3, "a mesh without faces"),
        ("empty", np.empty((0, 3)), [], 3, "no points in it"),
        ("nan", np.full((3, 3), np.nan), [[0, 1, 2]], 3, "none of its 3 points is finite"),
        ("far", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 3]], 3, "names vertex 3 of 3"),
    ],
)
def test_bad_meshes(tmp_path, name, vertices, faces, corners, message):
    with pytest.raises(BadInput, match=message):
        read_surface(binary_ply(tmp_path / f"{name}.ply", np.reshape(vertices, (-1, 3)), faces, corners=corners))


def test_bad_files(tmp_path):
    path = binary_ply(tmp_path / "mesh.ply", BOX.vertices, BOX.faces)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(BadInput, match="cut off"):
        read_surface(path)
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(BadInput, match="does not begin with 'ply'"):
        read_surface(tmp_path / "text.ply")
    with pytest.raises(BadInput, match="no such file"):
        read_surface(tmp_path / "missing.ply")
    (tmp_path / "mesh.xyzzy").write_text("hello")
    with pytest.raises(BadInput, match="cannot be read as a mesh"):
        read_surface(tmp_path / "mesh.xyzzy")


@pytest.mark.parametrize("name", ["faces.ply", "text.ply", "faces.obj"])
@pytest.mark.parametrize("corners", [[4], [5], [3, 4, 5], [4, 3]])
def test_faces_of_more_corners_are_triangulated(tmp_path, name, corners):
    """The areas of regular polygons of radius 1, side by side."""
    path, vertices, faces = tmp_path / name, [], []
    for at, count in enumerate(corners):
        faces.append([len(vertices) + k for k in range(count)])
        turn = 2 * np.pi * np.arange(count) / count
        vertices += np.column_stack([np.cos(turn) + 3 * at, np.sin(turn), 0 * turn]).tolist()
    if name.endswith(".obj"):
        lines = [f"v {x} {y} {z}\n" for x, y, z in vertices]
        path.write_text("".join(lines + [f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces]))
    else:
        kind = "ascii" if name == "text.ply" else "binary_little_endian"
        head = f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz")
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        if kind == "ascii":
            rows = [*vertices, *([len(face), *face] for face in faces)]
            body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
        else:
            body = np.array(vertices, "<f4").tobytes()
            body += b"".join(bytes([len(face)]) + np.array(face, "<i4").tobytes() for face in faces)
        path.write_bytes(head.encode() + body)
    found = read_surface(path)
    wanted = sum(count / 2 * np.sin(2 * np.pi / count) for count in corners)
    assert face_areas(found).sum() == pytest.approx(wanted, rel=1e-5)


def scan(path, points, system=None):
    """A LAS or LAZ file of points on a millimetre, by laspy."""
    laspy = needs("laspy")
    needs("lazrs")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.offsets, header.scales = points.min(0), np.full(3, 0.001)
    if system is not None:
        text = pyproj.CRS(system).to_wkt("WKT1_GDAL")
        header.vlrs.append(needs("laspy.vlrs.known").WktCoordinateSystemVlr(text))
    made = laspy.LasData(header)
    made.x, made.y, made.z = points.T
    made.write(path)


PLACES = np.random.default_rng(0).uniform(0, 50, (2_000, 3)) + [500_000.0, 5_800_000.0, 100.0]


@pytest.mark.parametrize("name", ["scan.las", "scan.laz", "SCAN.LAZ"])
def test_laser_scans_are_clouds(tmp_path, name, warned, monkeypatch):
    scan(tmp_path / name, PLACES, "EPSG:32633")
    found = read_surface(tmp_path / name)
    assert found.faces is None and np.abs(found.vertices() - PLACES).max() < 1e-3
    assert system_of(tmp_path / name) == "EPSG:32633" and not warned
    monkeypatch.setattr("surfkit.evaluate.geometry.las.CHUNK_POINTS", 300)
    xyz, rgb, _ = read_las(tmp_path / name, 900)
    assert np.abs(xyz - PLACES[::3]).max() < 1e-3 and rgb is None
    assert len(warned) == 1 and "667 of 2,000 points are used" in warned[0]


@pytest.mark.parametrize("version, kind", [("1.2", 3), ("1.4", 6)])
def test_noise_and_withheld_points_of_a_scan_are_no_surface(tmp_path, version, kind, warned):
    laspy = needs("laspy")
    made = laspy.LasData(laspy.LasHeader(version=version, point_format=kind))
    made.header.scales, made.header.offsets = [1e-3] * 3, PLACES.min(0)
    made.x, made.y, made.z = PLACES.T
    made.classification = np.where(np.arange(len(PLACES)) % 10 == 3, 7, 2)
    made.withheld = np.arange(len(PLACES)) % 10 == 4
    if kind == 6:
        made.classification[5::10] = 18
    made.write(tmp_path / "a.las")
    good = ~np.isin(np.arange(len(PLACES)) % 10, (3, 4, 5) if kind == 6 else (3, 4))
    found = read_surface(tmp_path / "a.las").vertices()
    assert found.shape == PLACES[good].shape and np.abs(found - PLACES[good]).max() < 1e-3
    assert len(warned) == 1 and f"{(~good).sum()} points are left out, which the file calls noise" in warned[0]
    made.withheld[:] = 1
    made.write(tmp_path / "a.las")
    with pytest.raises(BadInput, match="no points in it but 2,000 of noise"):
        read_surface(tmp_path / "a.las")


def test_a_file_that_is_no_scan_is_refused(tmp_path):
    needs("laspy")
    (tmp_path / "a.las").write_bytes(b"LASF, but no more")
    (tmp_path / "a.tif").write_bytes(b"II*, but no more")
    for name in ("a.las", "a.tif"):
        for use in (read_surface, system_of):
            with pytest.raises(BadInput, match=f"{name}: cannot be read"):
                use(tmp_path / name)
    (tmp_path / "a.e57").write_bytes(b"hello")
    with pytest.raises(BadInput, match="a.e57"):  # without pye57 that names the package
        read_surface(tmp_path / "a.e57")


@pytest.mark.filterwarnings("error::PendingDeprecationWarning:surfkit.evaluate.geometry.heights")
@pytest.mark.parametrize("turned", [0.0, 0.5])
@pytest.mark.parametrize("north_up", [True, False])
def test_a_raster_of_heights_is_a_mesh(tmp_path, north_up, turned, warned, monkeypatch):
    rasterio = needs("rasterio")
    rows, columns = np.indices((30, 40))
    heights = (100 + 0.5 * columns + 0.25 * rows).astype(np.float32)
    heights[3, 4] = -9999
    step = -2.0 if north_up else 2.0
    place = rasterio.Affine(2.0, turned, 500_000.0, turned / 2, step, 5_800_000.0)
    kind = {"driver": "GTiff", "width": 40, "height": 30, "count": 1, "dtype": "float32", "nodata": -9999}
    with rasterio.open(tmp_path / "dsm.tif", "w", **kind, transform=place, crs="EPSG:32633") as file:
        file.write(heights, 1)
    found = read_surface(tmp_path / "dsm.tif")
    xyz = found.vertices()
    assert len(xyz) == 30 * 40 - 1 and system_of(tmp_path / "dsm.tif") == "EPSG:32633"
    axes = np.array([[2.0, turned], [turned / 2, step]])
    column, row = np.linalg.solve(axes, (xyz[:, :2] - (500_000, 5_800_000)).T) - 0.5
    assert np.allclose(xyz[:, 2], 100 + 0.5 * column + 0.25 * row, atol=1e-4)
    corners = xyz[found.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()
    flat = np.abs(normals[:, 2]).sum() / 2
    # Six of the triangles of half a cell each meet in the cell without a height.
    assert flat == pytest.approx(abs(np.linalg.det(axes)) * (29 * 39 - 6 / 2))
    monkeypatch.setattr("surfkit.evaluate.geometry.heights.MAX_CELLS", 300)
    assert len(read_surface(tmp_path / "dsm.tif")) < 320 and "read as 20 x 15" in warned[-1]


def test_pictures_and_rasters_without_a_place_are_refused(tmp_path):
    Image.fromarray(np.zeros((9, 9, 3), np.uint8)).save(tmp_path / "photo.tif")
    with pytest.raises(BadInput, match="a picture of 3 bands"):
        read_surface(tmp_path / "photo.tif")
    Image.fromarray(np.zeros((9, 9), np.float32)).save(tmp_path / "dsm.tif")
    with pytest.raises(BadInput, match="where it lies"):
        read_surface(tmp_path / "dsm.tif")


def test_the_highest_points_of_a_cloud_are_a_surface():
    draw = np.random.default_rng(1)
    plan = draw.uniform(0, 30, (20_000, 2))
    ground = np.column_stack([plan, 0.1 * plan[:, 0]])
    roof = np.column_stack([10 + draw.uniform(0, 10, (30_000, 2)), np.full(30_000, 8.0)])
    found = highest(SurfaceFile(Path("given"), np.concatenate([ground, roof]) + [400_000, 0, 0]))
    xyz = found.vertices() - [400_000, 0, 0]
    inner = (np.abs(xyz[:, :2] - 15) < 4.5).all(1)
    outer = (np.abs(xyz[:, :2] - 15) > 6).any(1)
    assert (np.abs(xyz[inner, 2] - 8) < 1e-9).mean() > 0.98, "but for squares in which no point of the roof fell"
    assert np.abs(xyz[outer, 2] - 0.1 * xyz[outer, 0]).max() < 0.1
    assert inner.sum() > 500 and len(found.faces) > len(xyz)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("EPSG:32633", "epsg:32633", True),
        ("EPSG:25833", "EPSG:25833+7837", True),
        ("EPSG:32633", "EPSG:32634", False),
        ("EPSG:32633", "topocentric 1 2 3", False),
    ],
)
def test_systems_are_compared_in_plan(one, other, same):
    assert same_plan(one, other) is same


@pytest.mark.parametrize(
    ("system", "unit", "said"),
    [
        ("EPSG:32633+5773", "", ""),
        ("EPSG:25833+7837", "", "above DHHN2016 height, and those here above EGM96 height"),
        (None, "", ""),
        ("EPSG:32633", "", "heights here are above EGM96 height, and the other side does not say"),
        ("EPSG:32633+5773", "US survey foot", "in units of 0.3048006 m, and those here of 1 m"),
        ("EPSG:32633", "ft", "in units of 0.3048 m, and those here of 1 m"),
    ],
)
@pytest.mark.parametrize("kind", ["laz", "tif"])
def test_heights_above_something_else_or_in_another_unit_are_told(tmp_path, kind, system, unit, said):
    path = tmp_path / f"truth.{kind}"
    if kind == "laz":
        if unit:
            pytest.skip("units of heights alone are those of rasters")
        scan(path, PLACES, system)
    else:
        rasterio = needs("rasterio")
        form = {"driver": "GTiff", "width": 4, "height": 4, "count": 1, "dtype": "float32"}
        place = rasterio.Affine(1, 0, 500_000.0, 0, -1, 5_800_000.0)
        with rasterio.open(path, "w", **form, transform=place, crs=system) as file:
            file.write(np.zeros((4, 4), np.float32), 1)
            file.units = (unit,)
    ours, theirs = HeightSystem.of("EPSG:32633+5773"), HeightSystem.of(system_of(path), path)
    told = ours.contradicts(theirs) or ours.leaves_open(theirs)
    assert said in told and bool(said) == bool(told) if system else not ours.contradicts(theirs)


def test_heights_are_in_the_unit_of_their_map():
    feet = HeightSystem.of("EPSG:2263")
    assert feet.metres == pytest.approx(1200 / 3937) and not feet.datum
    assert not feet.contradicts(HeightSystem.of("EPSG:2263+6360")) and "sea level" in feet.leaves_open(
        HeightSystem.of("EPSG:2263+6360")
    )
    assert "in units of 1 m" in feet.contradicts(HeightSystem.of("EPSG:2263+5703"))
    local = "+proj=topocentric +ellps=WGS84 +lat_0=1.0 +lon_0=2.0 +h_0=3.0"
    assert HeightSystem.of(local) == HeightSystem() == HeightSystem.of(None)
    assert HeightSystem.of(pyproj.CRS("EPSG:32633").to_3d().to_wkt()).name == "the ellipsoid"


def test_a_cloud_has_no_triangles():
    faces = np.array([[0, 1, 2]])
    assert SurfaceFile(Path("box.ply"), np.eye(3), faces).triangles is faces
    with pytest.raises(ValueError, match="box.ply: a cloud of points"):
        _ = SurfaceFile(Path("box.ply"), np.eye(3)).triangles
