"""Programs of others read what is exported: bench/readers, where Node.js and its packages are installed."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from surfkit.core.registry import components
from surfkit.io.splats.base import Format
from surfkit.io.splats.splat_table import SplatTable

READERS = Path(__file__).parents[3] / "bench" / "readers"
COUNT = 300

pytestmark = [
    pytest.mark.skipif(shutil.which("node") is None, reason="Node.js is not installed"),
    pytest.mark.skipif(not (READERS / "node_modules").is_dir(), reason="bench/readers: npm ci was not run"),
]


@pytest.fixture(scope="module")
def check():
    """The module bench/readers/check.py."""
    kept = list(sys.path)
    sys.path.insert(0, str(READERS))
    import check

    yield check
    sys.path[:] = kept


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Random ellipsoids in every format."""
    torch.manual_seed(0)
    table = SplatTable(
        "gaussian",
        means=40 * torch.randn(COUNT, 3),
        quats=torch.randn(COUNT, 4),
        log_scales=torch.rand(COUNT, 3) * 4 - 3,
        opacity_logits=2 * torch.randn(COUNT),
        sh0=torch.rand(COUNT, 3) * 2 - 1,
        sh_rest=0.2 * torch.randn(COUNT, 15, 3),
    )
    folder = tmp_path_factory.mktemp("exports")
    for name, form in _files().items():
        form.write(folder / name, table)
    return folder


def _files() -> dict[str, Format]:
    found = components(Format)
    names = {"model.ply": "ply", "model.compressed.ply": "compressed-ply", "model.splat": "splat", "model.sog": "sog"}
    files = {name: found[form]() for name, form in names.items()}
    files |= {f"model.v{version}.spz": found["spz"](version=version) for version in (2, 4)}
    if "gltf" in found:
        files |= {"model.glb": found["gltf"](), "model.spz.glb": found["gltf"](compress="spz")}
    if "tiles3d" in found:
        files["model.tiles"] = found["tiles3d"](georeference=False)
    return files


@pytest.mark.parametrize("name", ["model.compressed.ply", "model.splat", "model.sog", "model.v2.spz", "model.v4.spz"])
def test_splat_transform_reads_each_format_within_its_precision(check, folder, name):
    reference = check.read_ply(folder / "model.ply")
    row = check.compared(folder / name, "splat-transform", reference, check.programs.splat_transform)
    assert row.is_right, row.note


def test_the_library_of_niantic_reads_spz(check, folder):
    row = check.compared(
        folder / "model.v4.spz", "spz", check.read_ply(folder / "model.ply"), check.programs.spz_library
    )
    assert row.is_right, row.note


@pytest.mark.skipif("gltf" not in components(Format), reason="glTF is not registered")
@pytest.mark.parametrize("name", ["model.glb", "model.spz.glb"])
def test_three_and_the_validator_of_khronos_read_gltf(check, folder, name):
    path = folder / name
    rows = [
        check.gltf_compared(path, check.read_ply(folder / "model.ply")),
        check.validated(path, "glTF-Validator", lambda p: check.programs.gltf_messages(p)[str(p)]),
    ]
    assert all(row.is_right for row in rows), [row.note for row in rows]


@pytest.mark.skipif("tiles3d" not in components(Format), reason="3D Tiles are not registered")
def test_three_reads_the_tiles_of_a_tileset(check, folder):
    row = check.tiles_compared(folder / "model.tiles", check.read_ply(folder / "model.ply"))
    assert row.is_right, row.note


@pytest.mark.parametrize("column", ["means", "log_scales", "quats", "alpha", "dc", "rest"])
def test_a_file_with_another_model_is_told(check, folder, column):
    reference = check.read_ply(folder / "model.ply")
    wrong = replace(reference, **{column: getattr(reference, column)[::-1].copy()})
    row = check.compared(folder / "model.ply", "anybody", wrong, check.read_ply)
    assert not row.is_right
