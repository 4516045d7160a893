"""Machines that lack what is optional: the suite is collected without an error, and a user is told what to install."""

import ast
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import hidden
import pytest
from hidden import NATIVE

from surfkit.cli import main
from surfkit.core.optional import INSTALLED_AS
from surfkit.raster import native
from surfkit.testing.synthetic import Flight, photograph, write_colmap

TESTS = Path(__file__).parent
PLUGINS = TESTS.parent / "plugins"
SUITE = (TESTS, PLUGINS)
TOOLS = {"mkdocs-material", "nvidia-cuda-nvrtc", "pre-commit", "pytest", "pytest-xdist", "ruff"}
"""Packages that no test imports."""
EXTRAS = [line for line in importlib.metadata.requires("surfkit") if "extra ==" in line]
IMPORTED_AS = {installed: name for name, installed in INSTALLED_AS.items()}
INSTALLED = {re.match(r"[\w-]+", line)[0] for line in EXTRAS} - TOOLS
OPTIONAL = sorted(IMPORTED_AS.get(name, name) for name in INSTALLED)
"""Packages of the extras, by the names that they are imported by."""
EVERYTHING = ",".join(OPTIONAL)
CASES = [f"missing:{package}" for package in (*OPTIONAL, NATIVE, f"{EVERYTHING},{NATIVE}")]
CASES += [f"ImportError:{EVERYTHING},{NATIVE}", f"OSError:{EVERYTHING}"]


@pytest.fixture(scope="module")
def collected():
    """By case, what pytest said, and its exit status."""
    words = [sys.executable, str(TESTS / "hidden.py"), os.pathsep.join(map(str, SUITE)), *CASES]
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    env |= {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "OMP_NUM_THREADS": "1"}
    said = subprocess.run(words, cwd=TESTS.parent, env=env, capture_output=True, text=True, check=True).stdout
    found = re.findall(r"^== (\w+:\S+)\n(.*?)^== (\d+)$", said, re.MULTILINE | re.DOTALL)
    return {case: (text, int(status)) for case, text, status in found}


@pytest.mark.parametrize("case", CASES)
def test_the_suite_is_collected(collected, case):
    text, status = collected[case]
    assert status == 0, text[-3000:]
    assert "tests/core/test_check.py: " in text and ("plugins/" in text or "," not in case)
    for file, package in {
        "test_fuzz.py": "hypothesis",
        "runs/execute/test_ray.py": "ray",
        "mesh/test_tsdf.py": "trimesh",
    }.items():
        assert f"tests/{file}: " not in text or package not in case.partition(":")[2].split(","), file


def test_every_optional_package_is_hidden():
    assert {"hypothesis", "lpips", "open3d", "OpenEXR", "ray", "submitit", "tensorboard", "trimesh"} < set(OPTIONAL)


def unguarded(source):
    """Imports of optional packages by other ways than `needs`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] in OPTIONAL)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OPTIONAL:
            yield node.module
        elif isinstance(node, ast.Attribute) and node.attr == "importorskip":
            yield node.attr


def test_tests_ask_for_optional_packages_in_one_way():
    files = [path for folder in (TESTS, *PLUGINS.glob("*/tests")) for path in folder.rglob("*.py")]
    found = {str(path.relative_to(PLUGINS.parent)): list(unguarded(path.read_text())) for path in files}
    assert not {name: wrong for name, wrong in found.items() if wrong}
    seen = "import os, ray\nfrom trimesh.creation import box\ndef f():\n    open3d = pytest.importorskip('open3d')"
    assert list(unguarded(seen)) == ["ray", "trimesh.creation", "importorskip"]


def test_without_a_compiler_the_reference_trains(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(native, "module", lambda: None)
    monkeypatch.setattr("surfkit.raster.select.warnings", warnings)  # not the skip of conftest.py
    write_colmap(tmp_path / "data", photograph(Flight(views=4, width=16, height=12, points=30)))
    words = ["recipe:2dgs", "mesh:none", "--steps", "2", "--primitive.sh-degree", "0", "--pictures-every", "0"]
    assert main(["train", *words, "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 0
    assert "without its compiled kernels" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "run.json").read_text())["device"].startswith("cpu reference")


@pytest.fixture
def broken(monkeypatch):
    """Open3D is installed, and finds no libusb."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "open3d"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [hidden.Broken(["open3d"], ImportError(hidden.LIBUSB)), *sys.meta_path])


def test_a_mesh_without_open3d_is_refused_in_one_line(broken, tmp_path, capsys):
    assert main(["mesh", str(tmp_path), "mesh:poisson"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("surfkit: mesh:poisson needs the package open3d, which ")
    assert "libusb-1.0.so.0" in said and "apt install " in said and "libusb-1.0-0" in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["--lods", "0.5"], ["--triangles", "9"], ["--error", "0.1"], ["--watertight"]])
def test_a_mesh_is_not_simplified_without_compiled_kernels(monkeypatch, tmp_path, capsys, words):
    monkeypatch.setattr("surfkit.mesh.simplify.module", lambda: None)
    assert main(["mesh", str(tmp_path), "mesh:tsdf", *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"surfkit: {words[0]} needs the compiled kernels: ") and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_training_does_not_begin_towards_a_mesh_that_cannot_be_made(broken, tmp_path, capsys):
    write_colmap(tmp_path / "data", photograph(Flight(views=3, width=16, height=12, points=30)))
    words = ["recipe:2dgs", "mesh:poisson", "--steps", "2", "--data", str(tmp_path / "data")]
    assert main(["train", *words, "--out", str(tmp_path / "out")]) == 2
    assert "mesh:poisson needs the package open3d" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
