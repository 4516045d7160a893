"""What users and other programs leave in the files that commands read back, and settings that cannot be meant."""

import ast
import json
import re
import shutil
from pathlib import Path

import pytest
import torch

import surfkit
from surfkit.cli import main
from surfkit.scene.crop import box, write_crop
from surfkit.testing.synthetic import Flight, photograph, write_colmap

RUN = "--steps 2 --device cpu --pictures-every 1 --primitive.sh-degree 1 --cache 1MB"
SWEEP = "prepare depth {m}/data estimator:plane-sweep"
CUT = "partition:quantile-grid --partition.blocks 2 1 assign:picture-share"
SHAPES = ("null", "[1]", "7", '"x"', "{}", "[" * 100_000 + "]" * 100_000, '{"a":' * 500 + "1" + "}" * 500)
pytestmark = pytest.mark.usefixtures("quick_comparison")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A data set with depth maps, a finished run of it, and one in blocks."""
    torch.set_num_threads(2)
    path = tmp_path_factory.mktemp("hostile")
    write_colmap(path / "data", photograph(Flight(views=6, width=24, height=18, points=60, test_every=3)), tracks=True)
    write_crop(path / "crop.json", box((-50.0, -50.0, -50.0, 50.0, 50.0, 50.0)))
    for out, more in (("run", ""), ("blocks", CUT)):
        assert main(f"train recipe:2dgs {RUN} {more} --data {path}/data --out {path}/{out}".split()) == 0
    assert main(f"{SWEEP.format(m=path)} --device cpu --estimator.max-planes 8".split()) == 0
    shutil.copy(path / "run" / "mesh.ply", path / "truth.ply")
    assert main(f"evaluate {path}/run --gt {path}/truth.ply --tau 0.5 --draws 1 --crop none".split()) == 0
    return path


def said(capsys, words):
    """Exit status and the lines of complaint."""
    capsys.readouterr()
    status = main(words.split())
    return status, [line for line in capsys.readouterr().err.splitlines() if line.startswith("surfkit:")]


GT = "evaluate {m}/run --gt {m}/truth.ply --tau 0.5 --draws 1"
AGAIN = f"train recipe:2dgs {RUN} --data {{m}}/data --out {{m}}/run"
BLOCKS = f"train recipe:2dgs {RUN} {CUT} --data {{m}}/data --out {{m}}/blocks"


@pytest.mark.parametrize(
    ("name", "words", "taken"),
    [
        ("run/mesh.json", AGAIN, ""),
        ("run/metrics.json", "status {m}/run", ""),
        ("run/metrics.json", AGAIN, ""),
        ("run/metrics.json", f"{GT} --crop none", "{}"),
        ("run/run.json", "export {m}/run", ""),
        ("run/recipe.json", "mesh {m}/run --device cpu", ""),
        ("run/recipe.json", AGAIN, ""),
        ("run/inputs.json", AGAIN, ""),
        ("crop.json", f"{GT} --crop {{m}}/crop.json", ""),
        ("crop.json", "mesh {m}/run --device cpu --crop {m}/crop.json", ""),
        ("crop.json", f"{GT} --crop none --transform {{m}}/crop.json", ""),
        ("blocks/blocks/plan.json", "status {m}/blocks", ""),
        ("blocks/blocks/plan.json", "train-block {m}/blocks 0 --device cpu", ""),
        ("blocks/blocks/000/state.json", "status {m}/blocks", "{}"),
        ("data/estimated_depths/depth.json", f"{SWEEP} --device cpu", ""),
    ],
)
def test_json_of_another_shape_is_one_line(made, capsys, name, words, taken):
    path = made / name
    whole = path.read_bytes()
    try:
        for shape in SHAPES:
            path.write_text(shape)
            status, lines = said(capsys, words.format(m=made))
            if shape == taken:
                assert (status, lines) == (0, [])
                path.write_bytes(whole)
                continue
            assert status == 2 and len(lines) == 1 and len(lines[0]) < 1000, (shape[:20], status, lines)
    finally:
        path.write_bytes(whole)


def test_geometry_that_is_damaged_in_the_metrics_is_one_line(made, capsys):
    path = made / "run" / "metrics.json"
    whole = path.read_text()
    try:
        for geometry in (None, [], {"precision": 1}, json.loads(whole)["geometry"] | {"crop": 7}):
            path.write_text(json.dumps(json.loads(whole) | {"geometry": geometry}))
            status, lines = said(capsys, AGAIN.format(m=made))
            assert status == 2 and "metrics.json: geometry is damaged" in lines[0] and len(lines) == 1
    finally:
        path.write_text(whole)


def test_figures_that_are_damaged_in_the_metrics_are_one_line(made, capsys):
    path, part = made / "run" / "metrics.json", {"psnr": 20.0, "ssim": 0.5, "share": 0.5}
    whole = json.loads(path.read_text())
    seen, seams = {"depth": "", "by_views": {"3": part}}, {"depth": "", "distance": 1.0, "near": part}
    damages = [{"seen": wrong} for wrong in (7, [1], "x", {"by_views": None}, {"by_views": {"3": None}})]
    damages += [{"seen": {"by_views": {"3": part | {name: "x"}}}} for name in ("psnr", "share")]
    damages += [{"seen": {"by_views": {"3": part | {"share": None}}}}, {"ssim": None}, {"lpips_vgg": None}]
    damages += [{"seams": wrong} for wrong in (7, ["near"], "near", {"near": part}, seams | {"elsewhere": []})]
    try:
        for images in ({"seen": seen, "seams": seams}, {"seen": None, "seams": None}):
            path.write_text(json.dumps(whole | {"images": whole["images"] | images}))
            assert said(capsys, AGAIN.format(m=made)) == (0, [])
        for damaged in [{"images": whole["images"] | images} for images in damages] + [{"prepare_cpu_seconds": "x"}]:
            path.write_text(json.dumps(whole | damaged))
            status, lines = said(capsys, AGAIN.format(m=made))
            assert status == 2 and "metrics.json: damaged; delete it" in lines[0] and len(lines) == 1, damaged
    finally:
        path.write_text(json.dumps(whole))


def test_links_to_themselves_and_folders_are_one_line(made, capsys, tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for place in ("loop", "."):
        for words in (
            f"evaluate {{m}}/run --gt {tmp_path}/{place} --tau 0.5",
            f"evaluate {{m}}/run --gt {{m}}/truth.ply --tau 0.5 --crop {tmp_path}/{place}",
            f"evaluate {{m}}/run --gt {{m}}/truth.ply --tau 0.5 --transform {tmp_path}/{place}",
            f"mesh {{m}}/run --device cpu --crop {tmp_path}/{place}",
            f"status {tmp_path}/{place}",
            f"train recipe:{tmp_path}/{place} --data {{m}}/data",
            f"prepare depth {tmp_path}/{place}",
            f"export {{m}}/run --out {tmp_path}/{place}",
            f"curves {tmp_path}/{place}",
        ):
            status, lines = said(capsys, words.format(m=made))
            assert status == 2 and len(lines) == 1, (words, status, lines)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            f"{GT} --crop none --samples 100000000000000",
            r"samples take 20000.0 TB, and .* free; give --samples \d+",
        ),
        (f"{GT} --crop none --draws 1000000", "--draws 1000000: give 1 to 1000"),
        ("evaluate {m}/run --gt {m}/truth.ply --tau 1e-30", r"--tau 1e-30: .* spans .* must lie between"),
        (f"{GT} --crop none --voxel 1e300", r"--voxel 1e\+300: .* spans .* must lie between"),
        (f"{GT} --crop none --far 1e-300", r"--far 1e-300: .* must lie between"),
        (f"{GT} --crop none --radius nan", "radius"),
        (
            f"{SWEEP} --again --estimator.window 999",
            "window is 999; it must lie between 3 and 51",
        ),
        (
            f"{SWEEP} --again --estimator.window 19",
            r"window is 19, and .* is 24 x 18 .* to 18",
        ),
        (
            f"{SWEEP} --estimator.neighbours 1000000",
            r"neighbours is .* must lie between 1 and 40",
        ),
        (
            f"{SWEEP} --estimator.longest 100000000000000000000",
            "longest is .* between 1 and 20000",
        ),
        (
            f"{SWEEP} --estimator.longest {10**400}",
            "longest is 10+; it must lie between 1 and 20000",
        ),
        (
            f"{SWEEP} --estimator.max-planes 1000000000",
            "max_planes is .* between 3 and 10000",
        ),
        (f"{SWEEP} --estimator.margin nan", "margin is nan"),
        (
            "prepare depth {m}/data --again estimator:patch-match --estimator.longest 100000000000000000000",
            "longest is .* between 32 and 20000",
        ),
        ("prepare depth {m}/data --again estimator:patch-match --estimator.agree 0", "agree is 0; .* between 1 and 16"),
        (
            "prepare depth {m}/data --again --longest 12 estimator:patch-match --estimator.window 17",
            r"window is 17, and .* is 12 x 9 .* to 9",
        ),
        ("mesh {m}/run mesh:tetra --mesh.bisections 1000000", "give 0 to 52"),
        (
            "mesh {m}/run mesh:tetra --mesh.min-views 100000000000000000000",
            r"mesh.min_views is 10+; give a whole number",
        ),
        ("mesh {m}/run --memory 99999999999999999999999TB", "--memory .* at most 1000TB"),
        ("train recipe:2dgs --data {m}/data --steps 1000000000000000", "--steps 1000000000000000: give 1 to 100000000"),
        ("train recipe:2dgs --data {m}/data --pretrain.steps 1000000000000000", "a stage has .* give 1 to 100000000"),
        ("train recipe:2dgs --data {m}/data --pretrain.densify.threshold nan", "pretrain.densify.threshold is nan"),
        ("doctor {m}/data --points 1000000000000000", "--points 1000000000000000: give 1 to 2147483647"),
        ("doctor {m}/data --probe 1000000000000000", "--probe 1000000000000000: give 0"),
    ],
)
def test_numbers_that_cannot_be_meant_are_refused(made, capsys, words, message):
    before = sorted(path for path in made.rglob("*"))
    status, lines = said(capsys, words.format(m=made))
    assert status == 2 and len(lines) == 1 and re.search(message, lines[0]), lines
    assert sorted(path for path in made.rglob("*")) == before, "nothing is written or deleted"


def test_costs_that_do_not_fit_into_memory_are_refused(made, capsys, monkeypatch):
    monkeypatch.setattr("surfkit.depth.plane_sweep.free_bytes", lambda: 10_000)
    status, lines = said(capsys, f"{SWEEP.format(m=made)} --again --device cpu")
    assert status == 2 and len(lines) == 1 and "give --estimator.longest" in lines[0]
    monkeypatch.undo()
    longest = lines[0].partition("--estimator.longest ")[2].split()[0]
    assert main(f"{SWEEP.format(m=made)} --again --device cpu --estimator.max-planes 8".split()) == 0
    assert 1 <= int(longest) < 24


def test_json_is_read_in_one_place():
    """Where its depth and its shape are checked."""
    root = Path(surfkit.__file__).parent
    found = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr in ("load", "loads") and ast.unparse(node.value) == "json":
                found.add(path.relative_to(root).as_posix())
    assert found == {"core/codec.py", "testing/component_checks.py"}
