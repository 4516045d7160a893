"""A stranger's methods: they train, resume, export, are meshed, ablated and measured as splatting is."""

import json
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from surfkit import Mesh, Method, Reconstruction, SplatModel, hookimpl
from surfkit.cli import main
from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load
from surfkit.core.events import Progress, StageBegan, StepDone, emit
from surfkit.core.registry import plugins
from surfkit.core.schedule import Steps
from surfkit.core.tree import evolve
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.data import Data
from surfkit.io.splats.ply import read_splats
from surfkit.mesh.fusion import TILES_PATTERN
from surfkit.mesh.stereo import Stereo
from surfkit.mesh.tsdf import TSDF
from surfkit.partition import QuantileGrid
from surfkit.primitives import Surfel2D
from surfkit.raster.api import Maps
from surfkit.runs.methods.stereo_fusion import StereoFusion
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.study.ablation import Row, Table, build
from surfkit.study.recipes.surface_recipes import STEREO, SURFACE
from surfkit.study.study import AblationPlan, ablate, trials
from surfkit.testing import check_method
from surfkit.testing.synthetic import Flight, photograph, write_colmap

SWEEP = PlaneSweep(longest=32, neighbours=2, max_planes=16)


def ground(scene, height):
    """A square of 10 x 10 quads below the cameras, at the height of the sparse points or above."""
    low = float(scene.cloud.xyz[:, 2].median()) + height
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.5, 0.5, 11), np.linspace(-0.5, 0.5, 11), indexing="ij"))
    at = np.array([11 * i + j for i in range(10) for j in range(10)])
    faces = np.concatenate([np.stack([at, at + 11, at + 12], 1), np.stack([at, at + 12, at + 1], 1)])
    return np.stack([x, y, np.full_like(x, low)], 1).astype(np.float32), faces.astype(np.int32)


@dataclass(frozen=True)
class Lower(Method):
    """Lower a plane step by step to the ground."""

    uses: ClassVar[tuple[str, ...]] = ()

    steps: Steps = 4
    """Optimisation steps."""
    wrong: bool = False
    """Refuse the data after the second step."""

    def length(self):
        return self.steps

    def reconstruct(self, given):
        path = given.folder / "state.json"
        done, height = json.loads(path.read_text()) if path.exists() else (0, 1.0)
        if done < self.steps:
            emit(StageBegan("lowering", self.steps, 0, first=done + 1))
        for index in range(done + 1, self.steps + 1):
            height *= 0.5
            assert given.photo(index).shape == (3, 36, 48) and given.mask(index) is None
            if self.wrong and index == 2:
                raise BadInput("the plane does not fit this scene; choose another method")
            emit(StepDone(index, self.steps, {"height": height}, 0))
            path.write_text(json.dumps([index, height]))
        vertices, faces = ground(given.scene, height)
        values = {"views": np.full(len(vertices), 3, np.float32)}
        mesh = Mesh(vertices, faces, facts={"levels": 2}, values=values)
        return Reconstruction(mesh=mesh, steps=self.steps, facts={"h": height})


@dataclass(frozen=True)
class Average(Method):
    """Draw every view in the mean colour of the photographs, at one depth."""

    uses: ClassVar[tuple[str, ...]] = ("mesh",)
    calls: ClassVar[list] = []

    def reconstruct(self, given):
        self.calls.append(given.scene.held_out)
        path = given.folder / "color.json"
        if not path.exists():
            colors = [given.photo(at).float().mean((1, 2)) / 255 for at in range(len(given.scene.train))]
            path.write_text(json.dumps(torch.stack(colors).mean(0).tolist()))
            emit(Progress("averaging", 1, 1))
        color = torch.tensor(json.loads(path.read_text()))

        def draw(view):
            size = view.camera.height, view.camera.width
            one = torch.ones(size)
            distance = view.camera.centre.norm().float() * one
            return Maps(color[:, None, None].expand(3, *size), one, distance, distance)

        return Reconstruction(draw=draw)


@dataclass(frozen=True)
class Sparse(Method):
    """Splats at the sparse points."""

    uses: ClassVar[tuple[str, ...]] = ("primitive", "mesh")

    def reconstruct(self, given):
        primitive = given.used["primitive"]
        params = primitive.init(given.scene.cloud, given.generator)
        return Reconstruction(splats=SplatModel(primitive, params))


@dataclass(frozen=True)
class Broken(Method):
    """Return what cannot be used."""

    how: str = "nothing"
    """What is wrong."""

    def reconstruct(self, given):
        vertices, faces = ground(given.scene, 0.0)
        return {
            "nothing": Reconstruction(),
            "faces": Reconstruction(mesh=Mesh(vertices, faces + 100)),
            "nan": Reconstruction(mesh=Mesh(vertices * np.float32("nan"), faces)),
            "kind": Reconstruction(mesh=Mesh(vertices.astype(float), faces)),
        }[self.how]


class Strangers:
    """What their package offers."""

    @hookimpl
    def surfkit_components(self):
        return {"lower": Lower, "average": Average, "sparse-splats": Sparse, "broken": Broken}


@pytest.fixture(autouse=True)
def strangers():
    package = Strangers()
    plugins().register(package, "strangers")
    yield
    plugins().unregister(package)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Data:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("data") / "farm"
    flight = Flight(kind="grid", views=8, width=48, height=36, points=300)
    write_colmap(folder, photograph(flight), tracks=True)
    return Data(folder)


class Stop:
    """Interrupts a run after a step, as Ctrl-C does."""

    def __init__(self, index):
        self.index = index

    @hookimpl
    def surfkit_event(self, event):
        if isinstance(event, StepDone) and event.index == self.index:
            raise KeyboardInterrupt


def interrupted(words, index):
    stop = Stop(index)
    plugins().register(stop)
    try:
        return main(words)
    finally:
        plugins().unregister(stop)


def test_a_mesh_method_from_the_command_line(data, tmp_path, capsys):
    out = tmp_path / "run"
    words = ["train", "recipe:2dgs", "method:lower", "--method.steps", "5", "--data", str(data.path), "--out", str(out)]
    assert interrupted(words, 3) == 130
    assert main(["status", str(out)]) == 3
    told = capsys.readouterr().out
    assert "2 of 5 of lowering" in told and "stopped" in told and "points" not in told
    assert main(["evaluate", str(out)]) == 2 and "method:lower has not finished" in capsys.readouterr().err
    assert main(words) == 0
    said = capsys.readouterr()
    assert "not measured: method:lower does not draw pictures" in said.out and "point_cloud" not in said.out
    steps = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert [line["index"] for line in steps if line["event"] == "StepDone"] == [1, 2, 3, 4, 5], "none made twice"
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["points"] is None and metrics["steps"] == 5 and metrics["images"]["psnr"] is None
    assert metrics["method"] == {"h": 0.5**5} and metrics["seconds"] > 0 and metrics["fps"] is None
    recipe = json.loads((out / "recipe.json").read_text())
    assert recipe["method"] == {"use": "lower", "steps": 5, "wrong": False} and recipe["mesh"] is None
    assert json.loads((out / "mesh.json").read_text())["facts"] == {"levels": 2}
    vertices = read_surface(out / "mesh.ply").vertices()
    assert len(vertices) == 121 and np.ptp(vertices[:, 2]) < 1e-3, "the plane, in the frame of the input"
    assert main(["status", str(out)]) == 0
    assert main(words) == 0 and "is finished" in capsys.readouterr().err
    (out / "metrics.json").unlink()
    (out / "method" / "state.json").unlink()
    lines = (out / "events.jsonl").read_text().count("StepDone")
    assert main(words) == 0 and (out / "events.jsonl").read_text().count("StepDone") == lines, "its mesh is kept"
    assert len(list((out / "mesh_pictures").glob("*.png"))) == 6
    capsys.readouterr()
    assert main([*words[:4], "6", *words[5:]]) == 2
    assert "method.steps 5, and this one has 6" in capsys.readouterr().err


def test_each_command_works_for_it_or_says_in_one_line_what_does_not_apply(data, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["train", "recipe:2dgs", "method:lower", "--data", str(data.path), "--out", str(out)]) == 0

    def refused(*words):
        assert main(list(map(str, words))) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        return line

    capsys.readouterr()
    assert "makes no splats, so there are no points to write" in refused("export", out)
    assert "method:lower does not draw pictures" in refused("evaluate", out, "--seen", 2)
    assert main(["evaluate", str(out)]) == 0 and "boundary edges" in capsys.readouterr().out
    assert json.loads((out / "metrics.json").read_text())["mesh"]["components"] == 1
    assert "the method of the run made its mesh" in refused("mesh", out, "mesh:tsdf", "--mesh.voxel", 1)
    assert "the method of the run made its mesh" in refused("mesh", out, "--mesh.voxel", 1)
    assert "has no points; draw --of loss" in refused("curves", out, "--out", tmp_path / "curves.png")
    assert "does not draw pictures" in refused("evaluate", out, "--gt", out / "mesh.ply", "--tau", 1, "--seen", 2)
    assert "no blocks" in refused("train-block", out, 0)
    curve = ["curves", str(out), "--of", "loss", "--out", str(tmp_path / "curves.png")]
    assert main(curve) == 0 and (tmp_path / "curves.png").exists()
    assert main(["mesh", str(out), "--formats", "ply", "obj"]) == 0 and (out / "mesh.obj").exists()
    assert b"property float views\n" in (out / "mesh.ply").read_bytes()[:500], "it is kept with the result"
    assert main(["evaluate", str(out), "--gt", str(out / "mesh.ply"), "--tau", "0.5"]) == 0
    assert json.loads((out / "metrics.json").read_text())["geometry"]["f1"] > 0.99
    capsys.readouterr()
    assert main(["doctor", str(data.path), "recipe:2dgs", "method:lower", "--probe", "2"]) == 0
    told = capsys.readouterr().out
    assert (
        "reconstruct with method:lower" in told
        and "no estimate for method:lower" in told
        and "start from 300" not in told
    )


def test_what_the_method_does_not_use_is_refused_before_anything_is_written(data, tmp_path, capsys):
    words = ["train", "recipe:surface", "method:lower", "--data", str(data.path), "--out", str(tmp_path / "run")]
    for more in (
        ["--pretrain.steps", "5"],
        ["partition:contracted-grid"],
        ["--min-views", "3"],
        ["pretrain.densify:none"],
        ["mesh:tsdf"],
        ["depth:patch-match"],
        ["--pictures-every", "3"],
    ):
        assert main([*words, *more]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert "method:lower does not use it" in line and more[0] in line, line
    with pytest.raises(BadInput, match="^partition: method:lower .*leave it out.*method:splats"):
        run(replace(Recipe(method=Lower()), partition=QuantileGrid()), data, tmp_path / "run")
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"method": {"use": "lower"}, "context": "tuned"}))
    assert main(["train", f"recipe:{path}", *words[3:]]) == 2 and "context: method:lower" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    with pytest.raises(BadInput, match="method:broken .*leave it out"):
        with_steps(Recipe(method=Broken()), 10)
    assert with_steps(Recipe(method=Lower()), 10) == Recipe(method=Lower(steps=10))


def test_data_that_do_not_fit_and_wrong_results_are_one_line(data, tmp_path, capsys):
    with pytest.raises(BadInput, match="the plane does not fit"):
        run(Recipe(method=Lower(wrong=True)), data, tmp_path / "unfit")
    for how, said in {
        "nothing": "no mesh, no splats",
        "faces": "121 vertices .* vertex 220",
        "nan": "NaN or Inf",
        "kind": r"\(121, 3\) float64; .*\(V, 3\) float32",
    }.items():
        with pytest.raises(BadInput, match=said):
            run(Recipe(method=Broken(how)), data, tmp_path / how)
        assert not (tmp_path / how / "metrics.json").exists()


def test_a_method_that_draws_is_measured_and_meshed(data, tmp_path, capsys):
    out = tmp_path / "run"
    words = ["train", "recipe:3dgs", "method:average", "mesh:tsdf", "--data", str(data.path), "--out", str(out)]
    assert main(words) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert 5 < metrics["images"]["psnr"] < 30 and metrics["fps"] > 0 and list((out / "pictures").glob("*.png"))
    assert json.loads((out / "mesh.json").read_text())["mesher"]["use"] == "tsdf" and (out / "mesh.ply").exists()
    assert set(Average.calls) == {()}, "held-out photographs are kept from it"
    calls = len(Average.calls)
    assert main(["evaluate", str(out), "--seen", "2"]) == 0 and len(Average.calls) == calls + 1
    again = json.loads((out / "metrics.json").read_text())["images"]
    assert again["psnr"] == metrics["images"]["psnr"] and "seen" in again
    assert main(["mesh", str(out), "mesh:tsdf", "--mesh.voxel", "2.0", "--metres-per-unit", "1"]) == 0


def test_a_method_that_makes_splats_writes_points_and_is_drawn_by_the_rasterizer(data, tmp_path):
    out = tmp_path / "run"
    words = ["train", "recipe:3dgs", "method:sparse-splats", "--data", str(data.path), "--out", str(out)]
    assert main([*words, "primitive:surfel2d", "--primitive.sh-degree", "1"]) == 0
    metrics, table = json.loads((out / "metrics.json").read_text()), read_splats(out / "point_cloud.ply")
    assert metrics["points"] == len(table) == 300 and table.kind == "surfel" and metrics["images"]["psnr"] > 5
    assert main(["export", str(out), "--out", str(tmp_path / "other.ply")]) == 0
    assert (tmp_path / "other.ply").read_bytes() == (out / "point_cloud.ply").read_bytes()
    assert main(["evaluate", str(out)]) == 0
    assert json.loads((out / "metrics.json").read_text())["images"]["psnr"] == metrics["images"]["psnr"]
    (out / "result" / "splats.safetensors").write_bytes(b"{")
    assert main(["export", str(out)]) == 2


def test_a_table_compares_methods_with_splats(data, tmp_path):
    stage = Recipe().pretrain
    base = Recipe(primitive=Surfel2D(sh_degree=0), pretrain=replace(stage, steps=3), mesh=TSDF())
    table = Table(
        "kinds",
        "Splats and other methods",
        with_steps(base, 3),
        (Row("splats"), Row("plane", {"method": Lower(steps=2)}, kept=False), Row("mean", {"method": Average()})),
    )
    recipes = build(table)
    assert recipes["plane"].mesh is None and recipes["mean"].mesh == base.mesh and recipes["mean"].pretrain == stage
    report = ablate(AblationPlan(table, (data,), tmp_path, device="cpu"), _Silent())
    splats, plane, mean = rows = report["data_sets"][0]["rows"]
    assert not [row["failed"] for row in rows if row["failed"]]
    assert set(plane["mean"]) == {"seconds", "cpu_seconds", "peak_memory_bytes"}
    assert set(mean["mean"]) == {*plane["mean"], "psnr", "psnr_aligned", "ssim", "ssim_aligned", "fps"}
    assert "points" in splats["mean"] and set(mean["difference"]) == set(mean["mean"])
    assert "| 2 | (plane) |" in (tmp_path / "ablation.md").read_text()
    lengths = [trial.recipe.length for trial in trials(AblationPlan(table, (data,), tmp_path, steps=6))]
    assert lengths == [6, 4, None]
    wrong = replace(table, rows=(Row("both", {"method": Lower(), "pretrain.steps": 7}),))
    with pytest.raises(BadInput, match="row 'both': pretrain.steps: method:lower"):
        build(wrong)


class _Silent:
    def begin(self, trial, at, count, report):
        pass

    def end(self, trial, outcome, report):
        pass


def test_recipes_of_before_are_read_as_splatting(data, tmp_path):
    plain = dump(SURFACE)
    assert plain.pop("method") == {"use": "splats"} and load(Recipe, plain) == SURFACE


def test_stereo_is_the_mesher_alone(data, tmp_path, own_cache, capsys, monkeypatch):
    """The same triangles as `mesh:stereo` makes for a run of splats, and a clear word where there are no maps."""
    mesher = Stereo(min_confidence=0.1, fusion=TSDF())
    splats = evolve(Recipe(depth=SWEEP, pretrain=replace(Recipe().pretrain, steps=1), mesh=mesher), "seed", 0)
    run(splats, data, tmp_path / "splats")
    alone = Recipe(depth=SWEEP, method=StereoFusion(mesher=mesher))
    left = tmp_path / "alone" / "method" / TILES_PATTERN.replace("*", "killed")

    def killed(self, given):
        left.mkdir(parents=True)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Stereo, "mesh", killed)
        run(alone, data, tmp_path / "alone")
    metrics = run(alone, data, tmp_path / "alone")
    assert not left.exists()
    assert (tmp_path / "alone" / "mesh.ply").read_bytes() == (tmp_path / "splats" / "mesh.ply").read_bytes()
    assert metrics["points"] is None and metrics["prepare_cpu_seconds"] > 0
    assert not (tmp_path / "alone" / "pretrain").exists()
    words = ["train", "recipe:2dgs", "method:stereo", "--data", str(data.path), "--out", str(tmp_path / "none")]
    assert main(words) == 2 and not (tmp_path / "none").exists()
    assert "depth:patch-match and without --no-prepare" in capsys.readouterr().err
    trust = replace(SURFACE.mesh.trust, covered_by=0)  # where stereo has no depth, nobody would seem to look
    fusion = replace(SURFACE.mesh, largest_px=0.0, oversampling=1.0, sky=True, trust=trust)
    assert STEREO.method.mesher.fusion == fusion, "it has no splats"
    assert STEREO.depth == SURFACE.depth and not STEREO.has_stages


def test_the_check_passes_sound_methods_and_finds_faults(data, tmp_path):
    for method in (Lower(), Average(), Sparse()):
        check_method(method, data, tmp_path / type(method).__name__)

    @dataclass(frozen=True)
    class Forgets(Lower):
        """Begins anew each time."""

        seen: ClassVar[list] = []

        def reconstruct(self, given):
            self.seen.append(1)
            made = Lower.reconstruct(self, given)
            return replace(made, mesh=replace(made.mesh, vertices=made.mesh.vertices + np.float32(len(self.seen))))

    @dataclass(frozen=True)
    class Unmarked(Lower):
        """Its length is not marked as Steps."""

        count: int = field(default=4)
        """Steps."""

        def length(self):
            return self.count

    class More:
        @hookimpl
        def surfkit_components(self):
            return {"forgets": Forgets, "unmarked": Unmarked}

    package = More()
    plugins().register(package)
    try:
        for method, said in {Forgets(): "another result", Unmarked(): "mark the setting as Steps"}.items():
            with pytest.raises(AssertionError, match=said):
                check_method(method, data, tmp_path / type(method).__name__)
        with pytest.raises(AssertionError, match="returned no mesh"):
            check_method(Broken(), data, tmp_path / "broken")
    finally:
        plugins().unregister(package)
