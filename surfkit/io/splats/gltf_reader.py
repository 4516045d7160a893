"""The reader of splats in glTF: files of surfkit, and of other programs that keep to KHR_gaussian_splatting.

Sources: see gltf.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.io.glb import UNLIT, GltfDocument, read_glb
from surfkit.io.splats.file_axes import Axes, FileAxes, turn_between
from surfkit.io.splats.rotate_splats import parts_of, turned
from surfkit.io.splats.splat_table import SPLAT_COLUMNS, SplatTable
from surfkit.io.splats.spz import SPZ_ROUNDING, spz_table
from surfkit.scene.rotations import numpy_rotations

SPLATS = "KHR_gaussian_splatting"
COMPRESSED = "KHR_gaussian_splatting_compression_spz_2"
UNDERSTOOD = {SPLATS, COMPRESSED, UNLIT, "KHR_mesh_quantization"}
"""Extensions that a file may require."""
UPS = {
    "y": np.eye(3),
    "-y": np.diag([-1.0, -1.0, 1.0]),  # half a turn about z, as programs of splats make with a PLY file
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""Rotations from an input whose vertical axis is this to that of glTF, which is y."""
GLTF_AXES: Axes = "luf"
"""Axes of glTF as SPZ names them: y is up, and models face z."""
WRITERS = ("splat-transform ",)
"""How `asset.generator` begins in files of programs that turn PLY files by half a turn about z, to these axes."""
LUF = turn_between("rub", GLTF_AXES)
MAX_OPACITY = 1 - 2.0**-24
"""Largest float32 below 1: opacities of 1 have no logit."""
MIN_NORMAL_FLOAT32 = float(np.finfo(np.float32).tiny)
MIN_BYTES_PER_SPLAT = 20
"""Bytes in a file that a splat takes at least, uncompressed: more splats than there are bytes for are refused."""
MAX_NODES = 100_000
LOG_SCALE_ROUNDING = 1e-5
"""Of logarithms of float32."""


def read_splats(path: Path) -> SplatTable:
    """The splats of a GLB file, all nodes of its scene together.

    Files of surfkit give the splats in the frame that they were written from; others in world coordinates, whose axes
    are GLTF_AXES, which those programs are known to keep that are in WRITERS.

    Raises:
        BadInput: Not such a file, damaged, or with something that splats cannot follow, such as a node that mirrors.
    """
    document = read_glb(path)
    required = _list(document, document.root, "extensionsRequired")
    if unknown := [name for name in required if name not in tuple(UNDERSTOOD)]:
        raise document.fault(f"requires the extension {unknown[0]!r}, which is not read"[:300])
    notes = _notes(document)
    back = np.eye(4)
    if notes:
        back[:3, :3], back[:3, 3] = UPS[notes["up"]].T, notes["offset"]
    tables = [
        _placed(document, table, back @ matrix)
        for matrix, mesh in _meshes(document)
        for table in _tables(document, mesh)
    ]
    if not tables and not notes:
        raise document.fault(f"no file of splats: no primitive of its scene has the extension {SPLATS}")
    table = joined(tables, notes.get("sh_degree", 0))
    if not notes:
        axes = FileAxes(GLTF_AXES, str(document.entry("asset", "generator")).startswith(WRITERS))
        is_coarse = COMPRESSED in _list(document, document.root, "extensionsUsed")
        return replace(table.as_surfels_if_thin(*(SPZ_ROUNDING if is_coarse else (LOG_SCALE_ROUNDING,))), axes=axes)
    table = replace(table, antialias=notes["antialias"])
    return table.as_surfels() if notes["kind"] == "surfel" else table


def _placed(document: GltfDocument, table: SplatTable, matrix: np.ndarray) -> SplatTable:
    try:
        turn, scale, move = parts_of(matrix)
    except BadInput as error:
        raise document.fault(str(error)) from error
    return turned(table, turn, scale, move)


def _notes(document: GltfDocument) -> dict[str, Any]:
    """What surfkit wrote for itself; nothing in a file of another program."""
    found = document.entry("asset", "extras", "surfkit")
    if not isinstance(found, dict):
        return {}
    offset = document.numbers(found.get("offset", [0, 0, 0]), 3, "asset.extras.surfkit.offset")
    degree, antialias = found.get("sh_degree"), found.get("antialias")
    sound = found.get("up") in tuple(UPS) and found.get("kind") in ("surfel", "gaussian")
    if not (sound and type(degree) is int and 0 <= degree <= 3 and isinstance(antialias, bool)):
        raise document.fault("damaged: asset.extras.surfkit is not what surfkit writes; write or copy it again")
    return {**found, "offset": offset}


def _meshes(document: GltfDocument) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """World matrix and mesh of each node of the scene that has one; a mesh is read once."""
    scene = document.item("scenes", document.root.get("scene", 0))
    waiting = [(np.eye(4), index) for index in reversed(_list(document, scene, "nodes"))]
    used: set[int] = set()
    passed: set[int] = set()
    while waiting:
        above, index = waiting.pop()
        node = document.item("nodes", index)
        if index in passed or len(passed) > MAX_NODES:
            raise document.fault(f"damaged: nodes[{index}] hangs below itself or below two others")
        passed.add(index)
        matrix = above @ _matrix(document, node, index)
        waiting += [(matrix, child) for child in reversed(_list(document, node, "children"))]
        if "mesh" in node:
            mesh = document.item("meshes", node["mesh"])
            if node["mesh"] in used:
                raise document.fault(f"meshes[{node['mesh']}] is drawn by two nodes; only one each is read")
            used.add(node["mesh"])
            yield matrix, mesh


def _list(document: GltfDocument, holder: Mapping[str, Any], key: str) -> list[Any]:
    found = holder.get(key, [])
    if not isinstance(found, list):
        raise document.fault(f"damaged: {key} is no list")
    return found


def _matrix(document: GltfDocument, node: dict[str, Any], index: int) -> np.ndarray:
    """(4, 4) of a node, from its matrix or from translation, rotation and scale."""
    where = f"nodes[{index}]"
    if "matrix" in node:
        return document.numbers(node["matrix"], 16, f"{where}.matrix").reshape(4, 4).T
    x, y, z, w = document.numbers(node.get("rotation", [0, 0, 0, 1]), 4, f"{where}.rotation")
    matrix = np.eye(4)
    matrix[:3, :3] = numpy_rotations(np.array([[w, x, y, z]]))[0]
    matrix[:3, :3] *= document.numbers(node.get("scale", [1, 1, 1]), 3, f"{where}.scale")
    matrix[:3, 3] = document.numbers(node.get("translation", [0, 0, 0]), 3, f"{where}.translation")
    return matrix


def _tables(document: GltfDocument, mesh: Mapping[str, Any]) -> Iterator[SplatTable]:
    """The splats of each primitive of a mesh that has some, in the axes of its node."""
    for primitive in _list(document, mesh, "primitives"):
        about = primitive.get("extensions", {}) if isinstance(primitive, dict) else None
        if not isinstance(about, dict):
            raise document.fault("damaged: a primitive is no object, or its extensions are none")
        if SPLATS not in about:
            continue
        about, attributes = about[SPLATS], primitive.get("attributes")
        if not isinstance(about, dict) or not isinstance(attributes, dict) or primitive.get("mode") != 0:
            raise document.fault(f"damaged: a primitive with {SPLATS} has no attributes, or is not made of points")
        for key, known in (("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")):
            if about.get(key, known) != known:
                raise document.fault(f"{key} is {about[key]!r}; only {known!r} is read"[:300])
        inner = about.get("extensions", {})
        if not isinstance(inner, dict) or set(inner) - {COMPRESSED}:
            raise document.fault(f"the splats have an extension that is not read; known: {COMPRESSED}")
        yield (_compressed if inner else _plain)(document, attributes, about)


def _compressed(document: GltfDocument, attributes: Mapping[str, Any], about: Mapping[str, Any]) -> SplatTable:
    """Of SPZ data, whose axes are those of the node; those of the draft where the file keeps to it (see gltf.py)."""
    where = about["extensions"][COMPRESSED]
    data, _ = document.view(where.get("bufferView") if isinstance(where, dict) else None)
    table = spz_table(bytes(data), document.path)
    count = document.item("accessors", attributes.get("POSITION")).get("count")
    if count != len(table):
        raise document.fault(f"damaged: {len(table)} splats in the SPZ data, and {count!r} by the accessors"[:200])
    return turned(table, LUF) if {"kernel", "colorSpace"} <= set(about) else table


def _plain(document: GltfDocument, attributes: Mapping[str, Any], about: Mapping[str, Any]) -> SplatTable:
    """Of accessors."""
    means = document.values(attributes.get("POSITION"), "VEC3")
    count = len(means)
    if count * MIN_BYTES_PER_SPLAT > len(document.block):
        raise document.fault(f"damaged: {count} splats in {len(document.block)} bytes; write or copy it again")

    def values(name: str, kind: str) -> np.ndarray:
        if f"{SPLATS}:{name}" not in attributes:
            raise document.fault(f"the splats lack {SPLATS}:{name}; write it by the release of that extension")
        return document.values(attributes[f"{SPLATS}:{name}"], kind, count)

    degree = max((band for band in (1, 2, 3) if f"{SPLATS}:SH_DEGREE_{band}_COEF_0" in attributes), default=0)
    rest = np.zeros((count, (degree + 1) ** 2 - 1, 3), np.float32)
    for name, at in harmonics(degree):
        rest[:, at] = values(name, "VEC3")
    opacity = values("OPACITY", "SCALAR")[:, 0].astype(np.float64).clip(MIN_NORMAL_FLOAT32, MAX_OPACITY)
    return SplatTable(
        kind="gaussian",
        means=torch.from_numpy(means),
        quats=torch.from_numpy(np.roll(values("ROTATION", "VEC4"), 1, axis=1)),
        log_scales=torch.from_numpy(np.log(values("SCALE", "VEC3").clip(MIN_NORMAL_FLOAT32))),
        opacity_logits=torch.from_numpy(np.log(opacity / (1 - opacity)).astype(np.float32)),
        sh0=torch.from_numpy(values("SH_DEGREE_0_COEF_0", "VEC3")),
        sh_rest=torch.from_numpy(rest),
    )


def harmonics(degree: int) -> Iterator[tuple[str, int]]:
    """Attributes of the degrees above 0, and which of the coefficients each has."""
    for band in range(1, degree + 1):
        for order in range(2 * band + 1):
            yield f"SH_DEGREE_{band}_COEF_{order}", band * band - 1 + order


def joined(tables: list[SplatTable], degree: int) -> SplatTable:
    """All splats in one table, with the harmonics of the highest degree; one without splats has `degree`."""
    if not tables:
        zeros = {"means": 3, "quats": 4, "log_scales": 3, "sh0": 3}
        empty: dict[str, Any] = {name: torch.zeros(0, width) for name, width in zeros.items()}
        rest = torch.zeros(0, (degree + 1) ** 2 - 1, 3)
        return SplatTable(kind="gaussian", opacity_logits=torch.zeros(0), sh_rest=rest, **empty)
    if len(tables) == 1:
        return tables[0]
    most = max(table.sh_rest.shape[1] for table in tables)
    padded = [
        replace(table, sh_rest=torch.nn.functional.pad(table.sh_rest, (0, 0, 0, most - table.sh_rest.shape[1])))
        for table in tables
    ]
    columns: dict[str, Any] = {name: torch.cat([getattr(table, name) for table in padded]) for name in SPLAT_COLUMNS}
    return replace(padded[0], **columns)
