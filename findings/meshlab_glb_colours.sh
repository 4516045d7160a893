#!/usr/bin/env bash
# MeshLab reads vertex colours of 16 bits in GLB files as noise.
#
# pymeshlab 2025.7. glTF 2.0 (3.7.2.1) allows COLOR_0 as bytes, 16-bit numbers and floats. The same colour, 0.1 0.2 0.3, is
# read right from bytes and from floats. From 16-bit numbers its bytes are taken one by one, without a warning.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pymeshlab==2025.7 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import json
import struct
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pymeshlab

print("pymeshlab", version("pymeshlab"))
corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
colour = np.array([0.1, 0.2, 0.3, 1.0])
seen = {}
for name, kind, code, most in (("8 bits", "<u1", 5121, 255), ("16 bits", "<u2", 5123, 65535), ("float", "<f4", 5126, 1)):
    stored = np.tile(colour * most if most == 1 else np.rint(colour * most), (3, 1)).astype(kind)
    parts = [corners.tobytes(), np.arange(3, dtype="<u4").tobytes(), stored.tobytes()]
    starts = np.cumsum([0, *map(len, parts)])[:-1].tolist()
    root = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1}]}],
        "buffers": [{"byteLength": sum(map(len, parts))}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part)} for start, part in zip(starts, parts)
        ],
        "accessors": [
            {"bufferView": 0, "count": 3, "componentType": 5126, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "count": 3, "componentType": 5125, "type": "SCALAR"},
            {"bufferView": 2, "count": 3, "componentType": code, "type": "VEC4", "normalized": code != 5126},
        ],
    }
    text, data = json.dumps(root).encode(), b"".join(parts)
    text, data = text + b" " * (-len(text) % 4), data + b"\0" * (-len(data) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(data), len(text), 0x4E4F534A)
    path = Path(sys.argv[1]) / f"{code}.glb"
    path.write_bytes(head + text + struct.pack("<II", len(data), 0x004E4942) + data)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    seen[name] = meshes.current_mesh().vertex_color_matrix().round(3).tolist()
    print(name, *seen[name], sep="\n    ")
for name in ("8 bits", "float"):
    assert np.abs(np.array(seen[name]) - colour).max() < 0.01, f"{name}: the behaviour has changed"
assert np.abs(np.array(seen["16 bits"]) - colour).max() > 0.3, "16 bits: the behaviour has changed"
PYTHON
