"""Which files a mesh becomes."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.events import Warned
from surfkit.mesh import files
from surfkit.mesh.base import Mesh
from surfkit.readers.data import Data
from surfkit.recipe import Recipe
from surfkit.run import mesh as delivering
from surfkit.run.folder import Run
from surfkit.run.mesh import MeshOutput, forget_geometry, write_files
from surfkit.scene.scene import Frame

TRIANGLE = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))


@pytest.mark.parametrize(
    ("formats", "written"), [(["glb"], ["mesh.ply"]), (["glb", "obj"], ["mesh.obj"]), (["ply", "glb"], ["mesh.ply"])]
)
def test_a_mesh_too_large_for_glb_is_not_lost(tmp_path, monkeypatch, formats, written):
    monkeypatch.setattr(files, "MOST_BYTES", 500)
    told = []
    monkeypatch.setattr(delivering, "emit", told.append)
    run, subject = SimpleNamespace(out=tmp_path), SimpleNamespace(frame=Frame(np.zeros(3), 1.0))
    found = list(write_files(run, [("mesh", TRIANGLE)], MeshOutput(formats=tuple(formats)), subject))
    assert [path.name for path in found] == written == [path.name for path in tmp_path.iterdir()]
    (warned,) = [event.text for event in told if isinstance(event, Warned)]
    assert "mesh.glb: 1 triangles" in warned and "at most 500" in warned
    assert ("in its place" in warned) == (formats == ["glb"])


def test_the_length_of_a_glb_file_is_known_before_it_is_begun(tmp_path, monkeypatch):
    path = tmp_path / "mesh.glb"
    files.write_glb(path, TRIANGLE, Frame(np.zeros(3), 1.0))
    monkeypatch.setattr(files, "MOST_BYTES", path.stat().st_size)
    files.write_glb(path, TRIANGLE, Frame(np.zeros(3), 1.0))
    monkeypatch.setattr(files, "MOST_BYTES", path.stat().st_size - 1)
    with pytest.raises(BadInput, match=f"take {path.stat().st_size} bytes"):
        files.write_glb(path, TRIANGLE, Frame(np.zeros(3), 1.0))


@pytest.mark.parametrize("part", ["", "compressed"])
def test_what_was_measured_of_the_mesh_before_is_gone(tmp_path, monkeypatch, part):
    """The metrics of a run repeat what was measured of the mesh of its compressed model, which is another mesh."""
    told, out = [], tmp_path / "run"
    monkeypatch.setattr(delivering, "emit", told.append)
    (out / "compressed").mkdir(parents=True)
    own, small = {"psnr": 20.0, "geometry": {"f1": 0.5}}, {"psnr": 19.0, "geometry": {"f1": 0.4}}
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
