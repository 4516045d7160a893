"""F1 of a row that compresses is that of the mesh of its compressed model."""

import json

import pytest
import torch

from surfkit.compress.vectree import Vectree
from surfkit.core.tree import evolve
from surfkit.io.datasets.data import Data
from surfkit.mesh.tsdf import TSDF
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.runs.recipe import Recipe
from surfkit.study.ablation import Row, Table
from surfkit.study.study import AblationPlan, ablate, report_so_far
from surfkit.study.truth import Truth
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = pytest.mark.usefixtures("quick_comparison")


class Silent:
    def begin(self, *_):
        pass

    def end(self, *_):
        pass


def rows_in(report):
    return report["data_sets"][0]["rows"]


def test_its_mesh_is_made_and_measured_once(tmp_path):
    torch.set_num_threads(1)
    write_colmap(tmp_path / "data", photograph(Flight(kind="grid", views=9, width=48, height=36, points=300)))
    base = evolve(Recipe(primitive=Surfel2D(sh_degree=1), mesh=TSDF()), "pretrain.steps", 10)
    rows = (Row("plain"), Row("+ VQ", {"compress": Vectree(ratio=1.0, codes=2)}))
    table, out = Table("small", "", base, rows), tmp_path / "out"
    data = (Data(tmp_path / "data"),)
    first = ablate(AblationPlan(table, data, out, device="cpu"), Silent())
    mesh = out / rows_in(first)[0]["runs"][0]["folder"] / "mesh.ply"
    plan = AblationPlan(table, data, out, device="cpu", truth=(Truth(mesh, 0.05),))
    plain, small = rows_in(ablate(plan, Silent()))
    assert plain["failed"] is None and small["failed"] is None, (plain["failed"], small["failed"])
    assert plain["mean"]["f1"] > 0.99 and 0 <= small["mean"]["f1"] < plain["mean"]["f1"]
    assert small["mean"].keys() == plain["mean"].keys(), "no column of the mesh is missing"
    assert 0 < plain["mean"]["chamfer"] < small["mean"]["chamfer"]
    folder = out / small["runs"][0]["folder"]
    assert (folder / "compressed" / "mesh.ply").exists()
    noted = json.loads((folder / "metrics.json").read_text())
    assert noted["compressed"]["geometry"]["f1"] == small["mean"]["f1"] and "geometry" not in noted
    assert small["mean"]["bytes"] == (folder / "compressed" / "model.surfkit").stat().st_size < plain["mean"]["bytes"]
    assert rows_in(report_so_far(plan)) == [plain, small], "it is known to be measured"
    other = AblationPlan(table, data, out, device="cpu", truth=(Truth(mesh, 0.1),))
    assert all("f1" not in row["mean"] for row in rows_in(report_so_far(other))), "that was with another threshold"
