"""`surfkit evaluate`: what it prints, writes and refuses."""

import json
import shutil

import numpy as np
import pytest
import torch
from needs import needs

from surfkit.cli import main
from surfkit.cli.recipes import recipes
from surfkit.core.codec import write_json
from surfkit.io.datasets.data import Data
from surfkit.io.splats.ply import write_points
from surfkit.partition.base import Cells, Ground
from surfkit.partition.plan import BlockPlan, PartitionPlan
from surfkit.runs.blocks.train_blocks import BlocksRecord
from surfkit.runs.pipeline import run
from surfkit.runs.recipe import with_steps
from surfkit.testing.synthetic import Flight, photograph, write_colmap

trimesh = needs("trimesh")
pytestmark = pytest.mark.usefixtures("quick_comparison")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set, the ground that it shows, and a finished run whose mesh is that ground, 1 cm too high."""
    torch.set_num_threads(2)
    path = tmp_path_factory.mktemp("evaluate")
    write_colmap(path / "data", photograph(Flight(width=64, height=48, points=300)))
    run(with_steps(recipes()["2dgs"], 2), Data(path / "data"), path / "run")
    x, y = np.meshgrid(np.arange(-9, 9, 0.2), np.arange(-9, 9, 0.2))
    ground = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    write_points(path / "truth.ply", ground, np.zeros((len(ground), 3), np.uint8))
    write_points(path / "run" / "mesh.ply", ground + [0, 0, 0.01], np.zeros((len(ground), 3), np.uint8))
    return path


def spoken(capsys, *words):
    status = main(["evaluate", *map(str, words)])
    return status, *capsys.readouterr()


def test_geometry_goes_beside_the_other_figures(folder, capsys):
    before = json.loads((folder / "run" / "metrics.json").read_text())
    status, said, _ = spoken(capsys, folder / "run", "--gt", folder / "truth.ply", "--draws", 1, "--visible", 0.4)
    metrics = json.loads((folder / "run" / "metrics.json").read_text())
    geometry = metrics.pop("geometry")
    assert status == 0 and metrics == before and geometry["f1"] == 1 and geometry["crop"]["from"] == "auto"
    assert geometry["classes"]["surface"]["ground"]["f1"] == 1 and geometry["classes"]["up_from"] == "cameras"
    assert "surface: ground" in said and "views: 3-5" in said and "class-surface-ground.png" in said
    assert "F1" in said and "similarity" in said and str(folder / "run" / "geometry" / "plan.png") in said
    assert spoken(capsys, folder / "run", "--lpips-weights", "none")[0] == 0  # the pictures once more
    after = json.loads((folder / "run" / "metrics.json").read_text())
    assert after["geometry"] == geometry and after["images"]["psnr"] == pytest.approx(before["images"]["psnr"])
    assert after["images"]["lpips_not_measured"] == "left out, by --lpips-weights none"


def test_pictures_of_an_earlier_comparison_go(folder, capsys):
    """They were listed among what was written, though the figures are those of another comparison."""
    words = folder / "run", "--gt", folder / "truth.ply", "--draws", 1, "--visible", 0.4
    assert spoken(capsys, *words)[0] == 0
    said = spoken(capsys, *words, "--no-classes")[1]
    pictures = {path.name for path in (folder / "run/geometry").glob("*.png")}
    assert "class-" not in said and "view0.png" in said and not [name for name in pictures if "class" in name]
    (folder / "run/geometry/view9.png").touch()
    assert "view9.png" not in spoken(capsys, *words)[1]


@pytest.mark.parametrize("views", ["run", "data"])
def test_a_file_needs_no_run(folder, capsys, tmp_path, views):
    options = (
        "--gt",
        folder / "truth.ply",
        "--views",
        folder / views,
        "--draws",
        1,
        "--out",
        tmp_path,
        "--visible",
        0.4,
    )
    assert spoken(capsys, folder / "run" / "mesh.ply", *options)[0] == 0
    assert json.loads((tmp_path / "metrics.json").read_text())["geometry"]["f1"] == 1
    crop = tmp_path / "geometry" / "crop.json"
    status, said, _ = spoken(capsys, folder / "truth.ply", *options[:2], "--crop", crop, *options[4:8])
    assert status == 0 and "+-" not in said and "area" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{f}/truth.ply"], "name the truth with --gt"),
        (["{f}/truth.ply", "--gt", "{f}/truth.ply"], "--crop auto needs the photographs"),
        (["{f}/truth.ply", "--gt", "{f}/nothing.ply", "--crop", "none"], "no such file"),
        (["{f}/run", "--views", "{f}/data"], "no effect without --gt"),
        (["{f}/run", "--tau", "0.3"], "no effect without --gt"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--device", "cpu"], "has no effect with --gt"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--views", "{f}/data"], "a run has views of its own"),
        (["{f}/data", "--gt", "{f}/truth.ply"], "no run folder"),
        (
            ["{f}/run", "--gt", "{f}/truth.ply", "--out", "{f}/truth.ply"],
            "truth.ply: a file is in the place of a folder",
        ),
        (["{f}/run", "--gt", "{f}/truth.ply", "--tau", "0"], "--tau 0: it is a length"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--crop", "{f}/data"], "cannot be read"),
        (["{f}/run", "--lpips-weights", "{f}"], "neither vgg16.ckpt"),
        (["{f}/run", "--seen", "0"], "--seen 0: it is a number of training views"),
        (["{f}/run", "--seen", "3", "99"], "--seen 99: there are 10 training views"),
        (["{f}/run", "--seams", "auto"], "plan.json: the run is not one in blocks"),
        (["{f}/run", "--seams", "-1"], "--seams -1: it is a length"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--seams", "auto"], "plan.json: the run is not one in blocks"),
        (["{f}/run", "--gt", "{f}/truth.ply", "--seen", "3"], "a cloud of points; --seen needs a mesh"),
        (["{f}/truth.ply", "--gt", "{f}/truth.ply", "--views", "{f}/data", "--seen", "3"], "--seen and --seams need"),
    ],
)
def test_mistakes_are_one_line(folder, capsys, words, message):
    status, said, error = spoken(capsys, *(word.format(f=folder) for word in words))
    lines = [line for line in error.splitlines() if not line.startswith("note:")]
    assert status == 2 and not said and len(lines) == 1 and message in lines[0], error


def test_a_run_without_a_mesh(folder, capsys, tmp_path):
    for name in ("recipe.json", "run.json", "metrics.json"):
        (tmp_path / name).write_bytes((folder / "run" / name).read_bytes())
    status, _, error = spoken(capsys, tmp_path, "--gt", folder / "truth.ply")
    assert status == 2 and "no mesh.ply in it; make it with surfkit mesh" in error


def test_a_mesh_of_an_earlier_model_is_not_measured(folder, capsys, tmp_path):
    shutil.copytree(folder / "run", tmp_path / "run")
    (tmp_path / "run" / "mesh.json").unlink()
    status, said, error = spoken(capsys, tmp_path / "run", "--gt", folder / "truth.ply")
    assert status == 2 and not said and "mesh.ply: without mesh.json it is of an earlier model" in error
    assert spoken(capsys, folder / "run", "--lpips-weights", "none")[1].count("mesh.ply") == 1
    assert "mesh.ply" not in spoken(capsys, tmp_path / "run", "--lpips-weights", "none")[1]


def test_another_unit_is_told(folder, capsys, tmp_path):
    y, x = np.meshgrid(np.arange(-9, 9, 0.2), np.arange(-9, 9, 0.2))
    small = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1) / 1000
    write_points(tmp_path / "small.ply", small, np.zeros((len(small), 3), np.uint8))
    words = (tmp_path / "small.ply", "--gt", folder / "truth.ply", "--views", folder / "run", "--visible", 0.4)
    status, _, error = spoken(capsys, *words)
    assert status == 2 and "another unit?" in error and "--transform" in error
    assert not list(tmp_path.glob("small-geometry/*"))


@pytest.fixture
def in_blocks(folder, tmp_path):
    """The run, as if it had been made in two blocks that meet at x = 0 of the local frame."""
    shutil.copytree(folder / "run", tmp_path / "run")
    ground = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    cells = Cells(ground, ((None, None, 0.0, None), (0.0, None, None, None)), (0, 1))
    blocks = tuple(BlockPlan(index, (), 0, 0, 0.5) for index in (0, 1))
    (tmp_path / "run" / "blocks").mkdir()
    write_json(tmp_path / "run" / "blocks" / "plan.json", BlocksRecord(2, PartitionPlan(cells, blocks)))
    return tmp_path / "run"


def square(path, half=9.0):
    """The ground as a mesh of two triangles."""
    corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False).export(path)
    return path


def test_pixels_that_enough_views_see(folder, capsys, tmp_path):
    shutil.copytree(folder / "run", tmp_path / "run")
    status, said, _ = spoken(capsys, tmp_path / "run", "--seen", 3, 8, "--lpips-weights", "none")
    images = json.loads((tmp_path / "run" / "metrics.json").read_text())["images"]
    assert status == 0 and "PSNR seen by 8+" in said and images["psnr"] > 0
    assert images["seen"]["depth"] == "rendered depth" and list(images["seen"]["by_views"]) == ["3", "8"]
    options = ("--gt", square(tmp_path / "truth.ply"), "--tau", 0.3, "--draws", 1, "--visible", 0.4)
    status, said, _ = spoken(capsys, tmp_path / "run", "--seen", 3, 8, *options)
    after = json.loads((tmp_path / "run" / "metrics.json").read_text())
    seen = after["images"]["seen"]
    assert status == 0 and seen["depth"] == "truth" and after["images"]["psnr"] == images["psnr"]
    assert 0.2 < seen["by_views"]["8"]["share"] < seen["by_views"]["3"]["share"] < 1
    assert after["geometry"]["f1"] > 0.9 and "class" in said and "PSNR seen by 3+" in said


def test_borders_of_blocks(in_blocks, folder, capsys):
    status, said, _ = spoken(capsys, in_blocks, "--seams", "auto", "--lpips-weights", "none")
    seams = json.loads((in_blocks / "metrics.json").read_text())["images"]["seams"]
    assert status == 0 and "of block borders" in said and seams["distance"].endswith("units")
    words = ("--gt", folder / "truth.ply", "--draws", 1, "--visible", 0.4)
    status, said, _ = spoken(capsys, in_blocks, "--seams", "auto", *words)
    found = json.loads((in_blocks / "metrics.json").read_text())["geometry"]["classes"]["seams"]
    assert status == 0 and "seams: near" in said and found["near"]["f1"] == found["elsewhere"]["f1"] == 1
    counts = [found[name]["points"]["truth"] for name in ("near", "elsewhere")]
    assert 0.01 < counts[0] / sum(counts) < 0.25
    status, _, error = spoken(capsys, in_blocks, "--seams", 2)
    assert status == 2 and "does not say how long its unit is; give --seams auto" in error


def ridges(path):
    """A mesh of ridges of 2 cm above z = 0, sides of 0.2 m at 11.3 degrees, and the plane in their middle as truth."""
    x = np.arange(-40, 41) * 0.1
    heights = np.where(np.arange(81) % 2, 0.02, 0.0)
    vertices = [[a, b, h] for b in (-4.0, 4.0) for a, h in zip(x, heights, strict=True)]
    faces = [face for i in range(80) for face in ([i, i + 1, 82 + i], [i, 82 + i, 81 + i])]
    trimesh.Trimesh(vertices, faces, process=False).export(path / "ridges.ply")
    flat = [[a, b, 0.01] for a, b in ((-4, -4), (4, -4), (4, 4), (-4, 4))]
    trimesh.Trimesh(flat, [[0, 1, 2], [0, 2, 3]], process=False).export(path / "flat.ply")
    return path / "ridges.ply", path / "flat.ply"


def test_a_mesh_by_itself(tmp_path, capsys):
    mesh, truth = ridges(tmp_path)
    status, said, _ = spoken(capsys, mesh)
    found = json.loads((tmp_path / "ridges-geometry" / "metrics.json").read_text())
    assert status == 0 and set(found) == {"mesh"} and found["mesh"]["boundary_edges"] == 162
    assert "160, 2.451 per square unit" in said and "0.000% of 160: all triangles" in said  # 160 / (64 * sqrt(1.04))
    assert spoken(capsys, mesh, "--device", "cpu")[0] == 2
    options = ("--gt", truth, "--tau", 0.1, "--crop", "none", "--align", "none", "--draws", 1)
    status, said, _ = spoken(capsys, mesh, *options)
    after = json.loads((tmp_path / "ridges-geometry" / "metrics.json").read_text())
    slope = np.degrees(np.arctan(0.2))
    assert after["mesh"]["triangles"] == 160 and after["geometry"]["f1"] > 0.99
    assert after["geometry"]["normals"]["median"] == pytest.approx(slope, abs=1e-4)
    assert after["geometry"]["normals"]["p90"] == pytest.approx(slope, abs=1e-4)
    assert after["geometry"]["roughness"]["on_truth_planes"] is None  # tau is too wide for the ball of 2 cm
    assert "half of them within 11.3 degrees" in said and "non-manifold edges" in said


def test_figures_of_another_mesh_do_not_stay_beside_those_of_this_one(tmp_path, capsys):
    mesh, truth = ridges(tmp_path)
    options = ("--gt", truth, "--tau", 0.1, "--crop", "none", "--align", "none", "--draws", 1, "--no-classes")

    def kept():
        return set(json.loads((tmp_path / "ridges-geometry" / "metrics.json").read_text()))

    assert spoken(capsys, mesh, *options)[0] == 0 and spoken(capsys, mesh)[0] == 0
    assert kept() == {"mesh", "geometry"}, "of the same mesh"
    other = trimesh.load(mesh, process=False)
    trimesh.Trimesh(other.vertices, other.faces[:-1], process=False).export(mesh)
    status, _, told = spoken(capsys, mesh)
    assert status == 0 and kept() == {"mesh"} and "F1 were of another mesh and are gone" in told
    assert spoken(capsys, mesh, *options)[0] == 0
    x, y = (each.ravel() for each in np.meshgrid(*[np.arange(-4, 4, 0.05)] * 2))
    write_points(mesh, np.stack([x, y, 0 * x], 1), np.zeros((len(x), 3), np.uint8))
    assert spoken(capsys, mesh, *options)[0] == 0 and kept() == {"geometry"}, "a cloud has no mesh by itself"


def test_roughness_where_the_truth_is_plane(tmp_path, capsys, monkeypatch):
    """Heights between 0 and h, all as often, have a standard deviation of h over the root of 12."""
    from surfkit.evaluate.mesh import roughness

    monkeypatch.setattr(roughness, "BALL_RADIUS_SHARE", 1 / 8)
    mesh, truth = ridges(tmp_path)
    options = ("--gt", truth, "--tau", 0.1, "--crop", "none", "--align", "none", "--draws", 1, "--out", tmp_path)
    assert spoken(capsys, mesh, *options)[0] == 0
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["geometry"]["roughness"]["radius"] == 1 and found["geometry"]["roughness"]["places"] > 300
    for rough in (found["geometry"]["roughness"]["on_truth_planes"], found["mesh"]["roughness"]["on_planes"]):
        assert rough == pytest.approx(0.02 / np.sqrt(12), rel=0.02)


def test_the_mesh_of_a_run_by_itself(folder, capsys, tmp_path):
    """In its units, and told beside the photographs; a mesh is measured again after it was made again."""
    shutil.copytree(folder / "run", tmp_path / "run")
    shutil.copy(ridges(tmp_path)[0], tmp_path / "run" / "mesh.ply")
    status, said, _ = spoken(capsys, tmp_path / "run", "--lpips-weights", "none")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert status == 0 and metrics["mesh"]["triangles"] == 160 and metrics["images"]["psnr"]
    assert "boundary edges" in said and "PSNR" in said
