"""A whole run of 2DGS on a simulated GPU: mesh and compressed model are made there, with the bits of the CPU."""

import json
import shutil
from dataclasses import replace

import pytest
import torch

from surfkit.cli.recipes import recipes
from surfkit.compress.cuda.codes import GpuSearch
from surfkit.compress.vectree import Vectree
from surfkit.io.datasets.data import Data
from surfkit.mesh.cuda.gpu_grid import GpuGrid
from surfkit.mesh.tsdf import TSDF
from surfkit.primitives import Surfel2D
from surfkit.raster.select import select
from surfkit.runs import pipeline
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.compress_model import compress_run
from surfkit.runs.make_mesh import make_mesh, mesh_input
from surfkit.runs.mesh_output import MeshOutput
from surfkit.runs.pipeline import loaded, run
from surfkit.runs.recipe import with_steps
from surfkit.testing.simulated_gpu import OnSimulatedGpu, simulated_gpu
from surfkit.testing.synthetic import Flight, photograph, write_colmap

pytestmark = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "c++", "clang++")), reason="the emulator needs a C++ compiler"
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run on the simulated GPU."""
    folder = tmp_path_factory.mktemp("scene")
    write_colmap(folder / "data", photograph(Flight(width=48, height=40, points=300)))
    small = with_steps(recipes()["2dgs"], 6)
    recipe = replace(
        small,
        primitive=Surfel2D(sh_degree=1),
        pretrain=replace(small.pretrain, densify=None),
        mesh=TSDF(),
        compress=Vectree(ratio=0.5, codes=16),
    )
    with pytest.MonkeyPatch.context() as patch, simulated_gpu():
        there(patch)
        run(recipe, Data(folder / "data"), folder / "run", Compute("cpu"))
    return folder / "run"


def there(patch):
    """Runs draw on the simulated GPU from now on."""
    patch.setattr(torch.cuda, "mem_get_info", lambda device=None: (1 << 34, 1 << 34))
    patch.setattr(pipeline, "select_rasterizer", lambda *given: (OnSimulatedGpu(select("cpu")[0]), "simulated"))


def made_again(out):
    """Bytes of the mesh and of the compressed model, made from the splats of a run."""
    with loaded(out, "cpu") as (ctx, made):
        recipe = ctx.run.recipe
        subject = mesh_input(ctx.run, made, ctx.scene, ctx.rasterizer, 1 << 30, recipe.mesh)
        make_mesh(ctx.run, recipe.mesh, MeshOutput(least_triangles=1), subject, 6)
        compress_run(ctx, made, recipe.compress)
    return (out / "mesh.ply").read_bytes(), (out / "compressed" / "model.surfkit").read_bytes()


def counted(function, used):
    """The same, and its name is noted."""

    def call(*given):
        used.append(function.__name__)
        return function(*given)

    return call


def test_a_run_ends_in_all_its_results(finished):
    assert json.loads((finished / "mesh.json").read_text())["facts"]["tiles"] == 1
    assert json.loads((finished / "compressed" / "compressed.json").read_text())["points"] == 300
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["images"]["psnr"] > 5 and metrics["compressed"]["images"]["psnr"] > 5


def test_the_bits_of_the_cpu(finished, tmp_path, monkeypatch):
    here = made_again(shutil.copytree(finished, tmp_path / "here"))
    used = []
    with monkeypatch.context() as patch, simulated_gpu():
        there(patch)
        for kind, name in ((GpuGrid, "fuse"), (GpuGrid, "surface"), (GpuSearch, "nearest")):
            patch.setattr(kind, name, counted(getattr(kind, name), used))
        twice = [made_again(shutil.copytree(finished, tmp_path / name)) for name in ("there", "again")]
    assert here == twice[0] == twice[1]
    assert used.count("surface") == 2 and used.count("fuse") > 4 and used.count("nearest") > 4
