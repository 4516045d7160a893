#!/usr/bin/env bash
# trimesh reads polygons of different sizes from text PLY files, and not from binary ones.
#
# trimesh 5.2.0. A quad and a triangle in one mesh are valid PLY (lists have their own lengths). The same mesh comes in
# whole from a text file; from a binary one trimesh takes the length of the first list for all, and raises
# "PLY is unexpected length!". Meshes of quads alone are fine in both. Programs of surveys and CAD write such files.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet trimesh==5.2.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import numpy as np
import trimesh

folder = Path(sys.argv[1])
places = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]], "<f4")


def write(name, faces, binary):
    kind = "binary_little_endian" if binary else "ascii"
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(places)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    if binary:
        body = places.tobytes() + b"".join(bytes([len(f)]) + np.array(f, "<i4").tobytes() for f in faces)
    else:
        rows = [*places.tolist(), *([len(f), *f] for f in faces)]
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    (folder / name).write_bytes(head.encode() + body)
    return folder / name


mixed, quads = [[0, 1, 2, 3], [1, 4, 2]], [[0, 1, 2, 3]]
print("trimesh", trimesh.__version__)
areas = {"text, mixed": trimesh.load(write("a.ply", mixed, False), process=False).area}
areas["binary, quads"] = trimesh.load(write("b.ply", quads, True), process=False).area
print("areas:", areas)
try:
    trimesh.load(write("c.ply", mixed, True), process=False)
    said = "read"
except ValueError as error:
    said = str(error)
print("binary, mixed:", said)
assert np.allclose(list(areas.values()), [1.5, 1.0])
assert said == "PLY is unexpected length!", "the behaviour has changed"
PYTHON
