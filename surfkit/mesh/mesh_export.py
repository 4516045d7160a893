"""Meshes as files, in the frame of the input without the offset of the run, which each file names: PLY, OBJ and GLB.

Our own and not trimesh's writers: for 4.5 million triangles, these need 110 (GLB), 470 (OBJ) and 60 MB (PLY) of memory,
and trimesh 380, 1250 and 390; its PLY has floats only.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO, Literal, get_args

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.files import replacing
from surfkit.core.version import own_version
from surfkit.io.glb import FLOAT, INDICES, UNSIGNED_INT, VERTICES, GlbWriter, linear_colors, write_glb
from surfkit.mesh.base import LENGTHS, Mesh
from surfkit.scene.scene import Frame

Format = Literal["ply", "obj", "glb"]
BATCH_ROWS = 1 << 20
"""Rows that are written at once."""
SURFACE = "surface"
"""Name of node, mesh and material in GLB: programs that open a file list them."""
GLTF_UP_MATRIX = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]
"""By columns, z up to y up, as glTF has it."""
OBJ_COLORS = np.ceil(np.arange(256) / 255 * 1e6) / 1e6
"""Bytes of colours as OBJ has them: rounded up, as some programs, MeshLab among them, cut off when they make bytes."""
GLB_UNKNOWN = -1.0
"""A value of a vertex that is not known, in GLB: glTF forbids NaN, and no value is below 0."""


def write_mesh(path: Path, mesh: Mesh, frame: Frame) -> list[Path]:
    """Write a mesh in the format that the name ends in, and return the files that were written.

    Raises:
        BadInput: The name ends in no such format.
    """
    kind = Path(path).suffix.lower()
    if kind.removeprefix(".") not in get_args(Format):
        known = ", ".join(f".{name}" for name in get_args(Format))
        raise BadInput(f"{path}: meshes are written as {known}; name it so")
    if kind == ".glb":
        return write_mesh_glb(path, mesh, frame)
    with replacing(path) as file:
        (write_ply if kind == ".ply" else write_obj)(file, mesh, frame)
    return [Path(path)]


def write_ply(file: BinaryIO, mesh: Mesh, frame: Frame) -> None:
    """Binary PLY with double coordinates; values of the vertices are properties of their names."""
    layout = [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]
    layout += [(name, "u1") for name in ("red", "green", "blue")] if mesh.colors is not None else []
    layout += [(name, "<f4") for name in mesh.values]
    kinds = {"<f8": "double", "u1": "uchar", "<f4": "float"}
    values = in_files(mesh, frame)
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {note}" for note in notes(frame))]
    header += [f"element vertex {len(mesh.vertices)}", *(f"property {kinds[kind]} {name}" for name, kind in layout)]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    file.write("".join(f"{line}\n" for line in header).encode())
    for at in range(0, len(mesh.vertices), BATCH_ROWS):
        rows = np.empty(len(mesh.vertices[at : at + BATCH_ROWS]), layout)
        rows["x"], rows["y"], rows["z"] = frame.to_file(mesh.vertices[at : at + BATCH_ROWS]).T
        if mesh.colors is not None:
            rows["red"], rows["green"], rows["blue"] = mesh.colors[at : at + BATCH_ROWS].T
        for name, each in values.items():
            rows[name] = each[at : at + BATCH_ROWS]
        file.write(rows.tobytes())
    for at in range(0, len(mesh.faces), BATCH_ROWS):
        rows = np.empty(len(mesh.faces[at : at + BATCH_ROWS]), [("count", "u1"), ("at", "<i4", 3)])
        rows["count"], rows["at"] = 3, mesh.faces[at : at + BATCH_ROWS]
        file.write(rows.tobytes())


def write_obj(file: BinaryIO, mesh: Mesh, frame: Frame) -> None:
    """OBJ with colours after the coordinates, as MeshLab, CloudCompare and Blender read them; values have no place."""
    file.write("".join(f"# {note}\n" for note in notes(frame)).encode())
    decimals = max(0, 6 - int(np.floor(np.log10(1 / frame.scale))))
    place = " ".join([f"%.{decimals}f"] * 3)
    for at in range(0, len(mesh.vertices), BATCH_ROWS):
        rows = frame.to_file(mesh.vertices[at : at + BATCH_ROWS])
        line = f"v {place}\n"
        if mesh.colors is not None:
            rows = np.concatenate([rows, OBJ_COLORS[mesh.colors[at : at + BATCH_ROWS]]], axis=1)
            line = f"v {place} %.6f %.6f %.6f\n"
        file.write("".join([line % tuple(row) for row in rows.tolist()]).encode())
    for at in range(0, len(mesh.faces), BATCH_ROWS):
        rows = (mesh.faces[at : at + BATCH_ROWS] + 1).tolist()
        file.write("".join([f"f {a} {b} {c}\n" for a, b, c in rows]).encode())


def write_mesh_glb(path: Path, mesh: Mesh, frame: Frame) -> list[Path]:
    """GLB, and NAME.glb.json, which names the offset. Colours are linear, as glTF has them.

    Values of the vertices are attributes of their own, _VIEWS and _ERROR: glTF 2.0 asks for the underscore. Those that
    are not known are `GLB_UNKNOWN`.

    Raises:
        BadInput: More than 4 GiB.
    """
    places, faces, count, blocks = (
        frame.to_file(mesh.vertices).astype("<f4"),
        mesh.faces,
        len(mesh.vertices),
        GlbWriter(),
    )
    view = blocks.add(places.nbytes, places.tobytes, target=VERTICES, byteStride=12)
    ends = {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    attributes = {"POSITION": blocks.accessor(view, count=count, componentType=FLOAT, type="VEC3", **ends)}
    view = blocks.add(4 * faces.size, lambda: faces.astype("<u4").tobytes(), target=INDICES)
    indices = blocks.accessor(view, count=faces.size, componentType=UNSIGNED_INT, type="SCALAR")
    if (colors := mesh.colors) is not None:
        view = blocks.add(12 * count, lambda: linear_colors(colors).tobytes(), target=VERTICES, byteStride=12)
        attributes["COLOR_0"] = blocks.accessor(view, count=count, componentType=FLOAT, type="VEC3")
    for name, each in in_files(mesh, frame).items():
        known = np.where(np.isfinite(each), each, np.float32(GLB_UNKNOWN))
        view = blocks.add(4 * count, known.tobytes, target=VERTICES, byteStride=4)
        attributes[f"_{name.upper()}"] = blocks.accessor(view, count=count, componentType=FLOAT, type="SCALAR")
    document = {
        "asset": {"version": "2.0", "generator": f"surfkit {own_version()}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": SURFACE} | ({"matrix": GLTF_UP_MATRIX} if frame.crs else {})],
        "materials": [
            {
                "name": SURFACE,
                "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
                "doubleSided": True,
            }
        ],
        "meshes": [{"name": SURFACE, "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
    }
    write_glb(path, document, blocks, "simplify the mesh, with --triangles")
    beside = Path(f"{path}.json")
    up = "y: the file turns z up to y up" if frame.crs else "as in the input"
    write_json(beside, {"offset": list(frame.shift), "metres_per_unit": frame.metres, "crs": frame.crs, "up": up})
    return [Path(path), beside]


def in_files(mesh: Mesh, frame: Frame) -> dict[str, np.ndarray]:
    """(V,) float32 values of the vertices by name, lengths in units of the input."""
    return {name: (each / frame.scale if name in LENGTHS else each).astype("<f4") for name, each in mesh.values.items()}


def notes(frame: Frame) -> list[str]:
    """What a file says of its coordinates."""
    return [f"Generated by surfkit {own_version()}", *frame.comments]
