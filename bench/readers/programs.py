"""The programs of others that read and write files of splats, each as a function from a file to splats."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from splat_columns import Splats, from_columns, made, read_ply, sigmoid, spz_head, to_columns, turned

HERE = Path(__file__).parent
MODULES = HERE / "node_modules"
TRANSFORM = MODULES / "@playcanvas/splat-transform/bin/cli.mjs"
VALIDATOR = "SURFKIT_TILES_VALIDATOR"


class Missing(Exception):
    """A program is not installed; the message says how to install it."""


def find_node() -> None:
    """Missing if Node.js or its packages are not there."""
    if shutil.which("node") is None:
        raise Missing("Node.js 20 or newer is missing: apt-get install nodejs npm")
    if not MODULES.is_dir():
        raise Missing(f"{MODULES} is missing: cd {HERE} && npm ci --ignore-scripts")


def find_chromium() -> str:
    """The program of a browser without a window."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        raise Missing("Chromium is missing: apt-get install chromium")
    return found


def node(*words: object, timeout: float = 600) -> str:
    """What a script prints. ValueError with its last line if it fails."""
    done = subprocess.run(["node", *map(str, words)], capture_output=True, text=True, timeout=timeout)
    if done.returncode:
        said = [line.strip() for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        told = [line for line in said if "rror" in line] or said or ["it says nothing"]
        raise ValueError(f"exit status {done.returncode}: {told[0][:200]}")
    return done.stdout


def is_as_in_ply(path: Path) -> bool:
    """Whether a .spz keeps the axes of PLY files: by its name, NAME.same.spz; files do not tell."""
    return path.name.endswith(".same.spz")


def splat_transform(path: Path) -> Splats:
    """PlayCanvas' splat-transform (MIT). It takes the axes of .spz files as those of PLY."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "read.ply"
        node(TRANSFORM, "-q", "-w", "-g", "cpu", path, out)
        got = read_ply(out)
    return turned(got) if path.suffix == ".spz" and not is_as_in_ply(path) else got


def write_by_splat_transform(source: Path, out: Path, *options: str) -> None:
    """Its writers."""
    node(TRANSFORM, "-q", "-w", "-g", "cpu", "-i", "2", *options, source, out)


def spz_library(path: Path) -> Splats:
    """The library of Niantic and Adobe that defines the format (@adobe/spz)."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "read.f32"
        said = json.loads(node(HERE / "spz.mjs", path, out, "UNSPECIFIED" if is_as_in_ply(path) else "RDF"))
        return from_columns(out, said["points"], said["degree"], linear=False)


def write_by_spz_library(splats: Splats, out: Path, version: int) -> None:
    """Its writer, from the axes of PLY to those of the format."""
    degree = round((splats.rest.shape[1] / 3 + 1) ** 0.5) - 1
    with TemporaryDirectory() as folder:
        columns = Path(folder) / "splats.f32"
        to_columns(splats, columns)
        node(HERE / "spz.mjs", "--write", columns, out, "RDF", version, degree)


KINDS = {".compressed.ply": "compressed.ply", ".ply": "ply", ".splat": "splat", ".spz": "spz", ".sog": "sog"}


def gaussforge(path: Path) -> Splats:
    """GaussForge (Apache-2.0), C++ with a Python package. It leaves the axes of .spz files as they are.

    Version 0.6.0 reads no file without further spherical harmonics, not even its own: no .splat.
    """
    kind = next(kind for suffix, kind in KINDS.items() if path.name.endswith(suffix))
    said = _forge().read(path.read_bytes(), kind)
    if "error" in said:
        raise ValueError(said["error"])
    data = said["data"]
    count = data["numPoints"]

    def column(name: str) -> np.ndarray:
        return np.frombuffer(data[name], "<f4").reshape(count, -1).astype(np.float64)

    sh = column("sh") if data["sh"] else np.zeros((count, 0))
    per = sh.shape[1] // 3
    rest = sh.reshape(count, per, 3).transpose(0, 2, 1).reshape(count, -1)
    alpha = sigmoid(column("alphas")[:, 0])
    got = made(column("positions"), column("scales"), column("rotations"), alpha, column("colors"), rest)
    return turned(got) if kind == "spz" and not is_as_in_ply(path) else got


def write_by_gaussforge(source: Path, out: Path) -> None:
    """Its writers."""
    kind = next(kind for suffix, kind in KINDS.items() if out.name.endswith(suffix))
    said = _forge().convert(source.read_bytes(), "ply", kind)
    if "error" in said:
        raise ValueError(said["error"])
    out.write_bytes(said["data"])


def _forge() -> Any:
    try:
        import gaussforge
    except ImportError as error:
        raise Missing("gaussforge is missing: pip install gaussforge") from error
    return gaussforge.GaussForge()


def three(path: Path) -> tuple[Splats | None, dict]:
    """The GLTFLoader of three.js (MIT), and what it says of the file. SPZ data go through the library of Niantic."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / ("read.same.spz")
        said = json.loads(node(HERE / "gltf.mjs", path, out))
        if said.get("spz"):
            return spz_library(out), said | {"spz_head": spz_head(out)}
        return from_columns(out, said["points"], said["degree"], linear=True), said


def gltf_messages(*paths: Path) -> dict[str, list[dict]]:
    """What the validator of Khronos (Apache-2.0) says of files."""
    return json.loads(node(HERE / "validate.mjs", *paths))


def tiles_messages(tileset: Path) -> list[dict]:
    """What the 3D Tiles validator of Cesium (Apache-2.0) says of a tileset, without what it repeats of glTF files."""
    main = os.environ.get(VALIDATOR) or MODULES / "3d-tiles-validator/build/main.js"
    if not Path(main).is_file():
        raise Missing(
            f"3d-tiles-validator is missing: npm install --no-save 3d-tiles-validator, or {VALIDATOR}=.../build/main.js"
        )
    with TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        node(main, "--tilesetFile", tileset, "--reportFile", report)
        return _leaves(json.loads(report.read_text()).get("issues", []))


def _leaves(issues: list[dict]) -> list[dict]:
    found = []
    for issue in issues:
        causes = issue.get("causes")
        found += _leaves(causes) if causes else [issue]
    return [issue for issue in found if not _is_name_of_splats(issue)]


def _is_name_of_splats(issue: dict) -> bool:
    """The messages that validate.mjs leaves out too."""
    names = issue.get("message") == "Invalid attribute name." and "/KHR_gaussian_splatting:" in issue.get("path", "")
    return names or "not supported by the validator: 'KHR_gaussian_splatting" in issue.get("message", "")


def trimesh_points(path: Path) -> np.ndarray:
    """(N, 3) positions as trimesh (MIT) reads them, the transforms of a glTF scene applied."""
    try:
        import trimesh
    except ImportError as error:
        raise Missing("trimesh is missing: pip install trimesh") from error
    got = trimesh.load(path)
    if isinstance(got, trimesh.Scene):
        got = got.to_geometry() if len(got.geometry) > 1 else next(iter(got.dump()))
    return np.asarray(got.vertices, np.float64)


def open3d_points(path: Path) -> np.ndarray:
    """(N, 3) positions as Open3D (MIT) reads them."""
    try:
        import open3d
    except ImportError as error:
        raise Missing("open3d is missing: pip install 'surfkit[mesh]'") from error
    return open3d.t.io.read_point_cloud(str(path)).point.positions.numpy().astype(np.float64)


def trimesh_triangles(path: Path) -> np.ndarray:
    """(F, 3, 3) corners of the triangles of a mesh, as trimesh reads them."""
    try:
        import trimesh
    except ImportError as error:
        raise Missing("trimesh is missing: pip install trimesh") from error
    return np.asarray(trimesh.load(path, process=False, force="mesh").triangles, np.float64)


def open3d_triangles(path: Path) -> np.ndarray:
    """(F, 3, 3) corners of the triangles of a mesh, as Open3D reads them."""
    try:
        import open3d
    except ImportError as error:
        raise Missing("open3d is missing: pip install 'surfkit[mesh]'") from error
    mesh = open3d.io.read_triangle_mesh(str(path))
    return np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
