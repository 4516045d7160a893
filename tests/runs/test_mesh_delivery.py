"""Which files a mesh becomes."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from needs import needs
from polygon_files import write_polygons

from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.events import Warned
from surfkit.io import glb
from surfkit.io.datasets.data import Data
from surfkit.mesh import mesh_export as files
from surfkit.mesh.base import Mesh
from surfkit.mesh.clean import clean
from surfkit.mesh.simplify import simplified
from surfkit.runs import make_mesh as delivering
from surfkit.runs.folder import Run
from surfkit.runs.make_mesh import finished, forget_geometry, levels, write_files
from surfkit.runs.mesh_output import MeshOutput
from surfkit.runs.recipe import Recipe
from surfkit.scene.scene import Frame

TRIANGLE = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))


@pytest.mark.parametrize(
    ("formats", "written"), [(["glb"], ["mesh.ply"]), (["glb", "obj"], ["mesh.obj"]), (["ply", "glb"], ["mesh.ply"])]
)
def test_a_mesh_too_large_for_glb_is_not_lost(tmp_path, monkeypatch, formats, written):
    monkeypatch.setattr(glb, "MAX_GLB_BYTES", 500)
    told = []
    monkeypatch.setattr(delivering, "emit", told.append)
    run, subject = SimpleNamespace(out=tmp_path), SimpleNamespace(frame=Frame(np.zeros(3), 1.0))
    found = list(write_files(run, [("mesh", TRIANGLE)], MeshOutput(formats=tuple(formats)), subject))
    assert [path.name for path in found] == written == [path.name for path in tmp_path.iterdir()]
    (warned,) = [event.text for event in told if isinstance(event, Warned)]
    assert "mesh.glb: " in warned and "at most 500: simplify the mesh" in warned
    assert ("in its place" in warned) == (formats == ["glb"])


def test_the_length_of_a_glb_file_is_known_before_it_is_begun(tmp_path, monkeypatch):
    path = tmp_path / "mesh.glb"
    files.write_mesh_glb(path, TRIANGLE, Frame(np.zeros(3), 1.0))
    monkeypatch.setattr(glb, "MAX_GLB_BYTES", path.stat().st_size)
    files.write_mesh_glb(path, TRIANGLE, Frame(np.zeros(3), 1.0))
    monkeypatch.setattr(glb, "MAX_GLB_BYTES", path.stat().st_size - 1)
    with pytest.raises(BadInput, match=f"mesh.glb: {path.stat().st_size} bytes"):
        files.write_mesh_glb(path, TRIANGLE, Frame(np.zeros(3), 1.0))


@pytest.mark.parametrize("part", ["", "compressed"])
def test_what_was_measured_of_the_mesh_before_is_gone(tmp_path, monkeypatch, part):
    """The metrics of a run repeat what was measured of the mesh of its compressed model, which is another mesh."""
    told, out = [], tmp_path / "run"
    monkeypatch.setattr(delivering, "emit", told.append)
    (out / "compressed").mkdir(parents=True)
    own = {"psnr": 20.0, "geometry": {"f1": 0.5}, "mesh": {"triangles": 2}}
    small = {"psnr": 19.0, "geometry": {"f1": 0.4}, "mesh": {"triangles": 1}}
    write_json(out / "metrics.json", own | {"compressed": small})
    write_json(out / "compressed" / "metrics.json", small)
    forget_geometry(Run(out / part, Recipe(), Data(tmp_path)))
    found = tuple(json.loads((out / name / "metrics.json").read_text()) for name in ("", "compressed"))
    if part:
        assert found == (own | {"compressed": {"psnr": 19.0}}, {"psnr": 19.0})
    else:
        assert found == ({"psnr": 20.0, "compressed": small}, small)
    forget_geometry(Run(out / part, Recipe(), Data(tmp_path)))
    assert len(told) == 1


@pytest.mark.parametrize(("metres", "local"), [(None, 0.002), (2.0, 0.001)])
def test_the_error_is_in_metres_or_else_in_units_of_the_data_set(metres, local):
    """0.02 in a frame whose unit is a tenth of that of the data set."""
    x, y = np.meshgrid(*2 * [np.linspace(0, 1, 40)], indexing="ij")
    at = np.arange(1600).reshape(40, 40)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    mesh = Mesh(np.stack([x, y, 0.1 * np.sin(5 * x)], 2).reshape(-1, 3).astype(np.float32), faces)
    subject = SimpleNamespace(frame=Frame(np.zeros(3), 0.1, metres), views=())
    found, done = finished(mesh, MeshOutput(error=0.02), subject)
    assert np.array_equal(found.faces, simplified(mesh, error=local).faces) and len(found.faces) < len(faces) / 2
    assert done == {"simplification": {"triangles_before": len(faces), "triangles": len(found.faces)}}
    assert finished(mesh, MeshOutput(), subject) == (mesh, {})


def slab(low, high, count):
    """A level floor and a level roof of so many squares along each side, in a frame as large as they are."""
    x, y = np.meshgrid(*2 * [np.linspace(0, 1, count + 1)], indexing="ij")
    at = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    floor, roof = (np.stack([x, y, np.full_like(x, height)], 2).reshape(-1, 3) for height in (low, high))
    whole = np.concatenate([faces[:, ::-1], faces + len(floor)]).astype(np.int32)
    return Mesh(np.concatenate([floor, roof]).astype(np.float32), whole)


@pytest.mark.parametrize("crs", ["EPSG:32633", "EPSG:4326", "EPSG:25832"])
def test_a_slab_cut_by_a_triangle_with_a_hole(tmp_path, crs):
    """Its roof has the area of the polygon and its volume is that times its height, within a row of triangles."""
    shapely = needs("shapely")
    east, north, side, count = 451_234.0, 5_873_211.0, 100.0, 200
    corners, hole = [(10, 8), (90, 30), (25, 85)], [(30, 30), (50, 35), (35, 50)]
    ring, inner = ([(east + x, north + y) for x, y in each] for each in (corners, hole))
    shape = shapely.Polygon(ring, [inner])
    path = write_polygons(tmp_path / "site.gpkg", shape, crs=crs)
    frame = Frame(np.array([east, north, 50.0]), 1 / side, 1.0, "EPSG:32633")
    mesh, subject = slab(0.02, 0.07, count), SimpleNamespace(frame=frame, views=())
    area = MeshOutput(area=path).area_of(subject, mesh)
    assert area.shape.area == pytest.approx(shape.area, rel=1e-5)
    found, report = clean(mesh, 50, 1, lambda local: area.inside(frame.to_input(local)))
    corners = found.vertices[found.faces].astype(np.float64) * side
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    up = normals[:, 2] > 0
    assert normals[up, 2].sum() == pytest.approx(shape.area, rel=5e-3)
    assert (corners.mean(1)[:, 2] * normals[:, 2]).sum() == pytest.approx(5 * shape.area, rel=5e-3)
    assert report.cropped == len(mesh.faces) - len(found.faces)


def balls(*divisions):
    """Balls beside each other, of 20, 80, 320 triangles and so on."""
    trimesh = needs("trimesh")
    found = trimesh.util.concatenate(
        [trimesh.creation.icosphere(each).apply_translation([3 * at, 0, 0]) for at, each in enumerate(divisions)]
    )
    return Mesh(found.vertices.astype(np.float32), found.faces.astype(np.int32))


def solid_of(mesh, scale):
    return needs("trimesh").Trimesh(mesh.vertices / scale, mesh.faces, process=False)


def test_what_is_told_of_a_closed_mesh_is_true_of_the_one_that_is_written(monkeypatch):
    """Its volume is less once it has fewer triangles; of three balls the smallest goes."""
    monkeypatch.setattr(delivering, "upright", lambda mesh, subject: np.array([0.0, 0.0, 1.0]))
    subject = SimpleNamespace(frame=Frame(np.zeros(3), 0.1), views=())
    delivery = MeshOutput(watertight=True, triangles=100, lods=(0.5,))
    mesh, done = finished(balls(3, 3, 0), delivery, subject)
    solid, told = solid_of(mesh, 0.1), done["closing"]
    assert told["volume"] == pytest.approx(solid.volume, rel=1e-5) and solid.volume < 2 * 4.1e3
    assert (told["bodies"], told["dropped"], told["dropped_triangles"]) == (solid.body_count, 1, 20) == (2, 1, 20)
    assert done["simplification"] == {"triangles_before": 2560, "triangles": len(mesh.faces)}

    def turning(mesh, most, error=None):  # the last body, as simplifying a thin one may
        faces = mesh.faces.copy()
        faces[-1280:] = faces[-1280:, ::-1]
        return Mesh(mesh.vertices, faces)

    monkeypatch.setattr(delivering, "simplified", turning)
    mesh, done = finished(balls(3, 3, 0), delivery, subject)
    told = done["closing"]
    assert (told["bodies"], told["dropped"], told["dropped_triangles"], len(mesh.faces)) == (1, 2, 1300, 1280)
    assert done["simplification"]["triangles"] == 1280
    level = levels(balls(3, 3), delivery, subject.frame)[1][1]
    assert len(level.faces) == 1280 and solid_of(level, 0.1).volume > 0


def test_a_level_that_would_not_be_closed_is_refused():
    with pytest.raises(BadInput, match="mesh cannot be closed: 3 "):
        levels(TRIANGLE, MeshOutput(watertight=True), Frame(np.zeros(3), 1.0))


def test_a_closed_mesh_whose_file_would_not_be_is_refused():
    """So far from 0 that 32 bits hold whole units only: two corners of a tetrahedron become one."""
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0, 9, 0], [0, 0, 9]], np.float32)
    solid = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32))
    far = Frame(np.array([1e7, 0, 0]), 1.0)
    assert levels(solid, MeshOutput(watertight=True), far) == [("mesh", solid)]
    with pytest.raises(BadInput, match=r"mesh\.glb .*closed: \d .*edges"):
        levels(solid, MeshOutput(watertight=True, formats=("glb",)), far)
