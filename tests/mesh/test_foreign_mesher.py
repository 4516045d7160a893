"""A mesher that surfkit knows nothing of, with facts of its own, in every command that meets one."""

import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from surfkit.apps.run_summary import mesh_rows
from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import plugins
from surfkit.core.tree import evolve
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.study.ablation import Row, Table
from surfkit.study.recipes.ablations import TABLES
from surfkit.testing.synthetic import Flight, photograph, write_colmap

ODD: dict[str, Any] = {
    "method": "a plane, né à la main",
    "passes": [{"k": 1, "kept": [True, None, 0.25]}, []],
    "deep": {"a": {"b": {"": -3}}},
    "none": None,
    "two\nlines": "tab\there",
    "many": list(range(200)),
    "tiles": 7,
    "far": float("inf"),
    "voxel": "not a number",
}


def sheet(side=20):
    """A wavy square around the origin, both windings of one side."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    vertices = np.stack([x, y, 0.01 * np.sin(9 * x)], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    faces = np.stack([corner, corner + 1, corner + side, corner + 1, corner + side + 1, corner + side], -1)
    return vertices, faces.reshape(-1, 3).astype(np.int32)


pytestmark = pytest.mark.usefixtures("quick_comparison")


@dataclass(frozen=True)
class Plane(Mesher):
    """A square, with the facts that a test wants."""

    case: str = "odd"
    """Name of the facts."""

    def mesh(self, subject: MeshInput) -> Mesh:
        return Mesh(*sheet(), facts=FACTS[self.case])


@dataclass(frozen=True)
class Bare(Mesher):
    """A square, and nothing else."""

    def mesh(self, subject: MeshInput) -> Mesh:
        return Mesh(*sheet())


class Weird:
    def __repr__(self):
        return "<weird>"


LOOP: dict[str, Any] = {}
LOOP["again"] = LOOP
FACTS: dict[str, Any] = {
    "odd": ODD,
    "none": None,
    "list": [1],
    "object": {"a": [0, Weird()]},
    "numpy": {"a": {"b": np.float32(0.5)}},
    "array": {"a": np.zeros(3)},
    "key": {"a": {1: 2}},
    "huge": {"a": 10**5000},
    "loop": LOOP,
}


class Stranger:
    @hookimpl
    def surfkit_components(self):
        return {"plane": Plane, "bare": Bare}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    plugin = Stranger()
    plugins().register(plugin, "stranger")
    folder = tmp_path_factory.mktemp("foreign")
    write_colmap(folder / "data", photograph(Flight(views=6, width=48, height=36, points=200)))
    words = ["recipe:2dgs", "--steps", "20", "--pictures-every", "0", "--primitive.sh-degree", "0"]
    words += ["mesh:plane", "--data", str(folder / "data"), "--out", str(folder / "run")]
    yield folder, words
    plugins().unregister(plugin)


def test_it_trains_and_its_facts_are_shown(finished, capsys):
    folder, words = finished
    assert main(["train", *words]) == 0
    shown = capsys.readouterr().out
    record = json.loads((folder / "run/mesh.json").read_text())
    assert record["facts"] == ODD | {"far": "inf"} and record["mesher"] == {"use": "plane", "case": "odd"}
    assert re.search("\nmethod +a plane, né à la main\n", shown) and re.search("\nvoxel +not a number\n", shown)
    assert '"tab\\there"' in shown and "0, 1, 2" in shown and "..." in shown
    assert main(["train", *words]) == 0, "and a finished run shows it again"
    assert "a plane, né à la main" in capsys.readouterr().out


def test_every_command_that_follows(finished, tmp_path, capsys):
    folder, words = finished
    assert main(["train", *words]) == 0
    for command in (
        ["status", str(folder / "run")],
        ["mesh", str(folder / "run")],
        ["mesh", str(folder / "run"), "--mesh.case", "none"],
        ["mesh", str(folder / "run"), "mesh:bare", "--formats", "ply", "obj"],
        ["evaluate", str(folder / "run"), "--gt", str(folder / "run/mesh.ply"), "--tau", "0.3"] + ["--draws", "1"],
    ):
        assert main(command) == 0, command
    assert json.loads((folder / "run/mesh.json").read_text())["facts"] == {}
    metrics = json.loads((folder / "run/metrics.json").read_text())
    assert metrics["geometry"]["f1"] == pytest.approx(1, abs=0.02), "of the mesh with itself"
    capsys.readouterr()


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("list", "mesh:plane: facts is a list, not a dict"),
        ("object", "mesh:plane: facts.a.1 is <weird> (Weird), which is not plain: give None, a bool, a number"),
        ("numpy", "(float32), which is not plain"),
        ("array", "mesh:plane: facts.a is array([0., 0., 0.]) (ndarray), which is not plain"),
        ("key", "mesh:plane: facts.a has the key 1 (int), which is not text"),
        ("huge", "mesh:plane: facts.a is an int beyond 64 bits"),
        ("loop", "lists and dicts are nested more than 50 levels deep"),
    ],
)
def test_what_is_not_plain_is_refused_in_one_line_and_changes_nothing(finished, capsys, case, message):
    folder, words = finished
    assert main(["train", *words]) == 0 and main(["mesh", str(folder / "run")]) == 0
    before = (folder / "run/mesh.json").read_text()
    capsys.readouterr()
    assert main(["mesh", str(folder / "run"), "--mesh.case", case]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("surfkit:")]
    assert len(lines) == 1 and message in lines[0], lines
    assert (folder / "run/mesh.json").read_text() == before and (folder / "run/mesh.ply").exists()


COUNTS = ("triangles", "vertices", "clusters_kept", "clusters", "boundaries", "boundary_share", "holes_closed")


def test_a_mesh_of_an_older_version_is_shown_too():
    cleaning = dict.fromkeys(COUNTS, 0)
    assert ("voxel m", "0.5") in mesh_rows({"cleaning": cleaning, "lengths": {"voxel_m": 0.5}, "seconds": 1.0})


def test_a_length_is_shown_once_where_the_unit_is_a_metre():
    cleaning = dict.fromkeys(COUNTS, 0) | {"boundaries": 6087, "boundary_share": 0.086}
    for metres, names in ((0.5, ["voxel m"]), (0.2, ["voxel", "voxel m"])):
        rows = mesh_rows({"cleaning": cleaning, "facts": {"voxel": 0.5, "voxel_m": metres}, "seconds": 1.0})
        assert [name for name, _ in rows if "voxel" in name] == names
    assert ("edges of holes and rims", "8.6% of all edges, in 6,087 loops") in rows


def test_a_row_of_an_ablation(finished, tmp_path, monkeypatch, capsys):
    folder, words = finished
    assert main(["train", *words]) == 0
    base = evolve(recipes()["2dgs"], "primitive.sh_degree", 0)
    rows = (Row("odd facts", {"mesh": Plane()}),)
    monkeypatch.setitem(TABLES, "meshers", Table("meshers", "Meshers of a stranger.", base, rows))
    data = ["--data", str(folder / "data"), "--steps", "10", "--out", str(tmp_path / "ablation"), "--probe", "0"]
    assert main(["ablate", "table:meshers", *data, "--gt", str(folder / "run/mesh.ply"), "--tau", "0.3"]) == 0
    shown = capsys.readouterr().out
    assert "odd facts" in shown and "F1" in shown
