#!/usr/bin/env bash
# trimesh writes vertex colours to GLB as they are, where glTF has linear ones.
#
# trimesh 5.2.0. Colours of vertices are sRGB in PLY and OBJ. glTF 2.0 (3.7.2.1, COLOR_0) takes vertex colours as linear.
# A mesh that is read from PLY and exported to GLB has the bytes of the PLY in COLOR_0: 128 of sRGB is shown as 188.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet trimesh==5.2.0 numpy==2.4.6
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import json
import struct
import sys
from pathlib import Path

import numpy as np
import trimesh

folder = Path(sys.argv[1])
head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {axis}\n" for axis in "xyz")
head += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
grey = "0 0 0 128 128 128\n1 0 0 128 128 128\n0 1 0 128 128 128\n3 0 1 2\n"
(folder / "a.ply").write_text(head + grey)
data = trimesh.load(folder / "a.ply", process=False).export(file_type="glb")
(size,) = struct.unpack_from("<I", data, 12)
root, binary = json.loads(data[20 : 20 + size]), data[28 + size :]
accessor = root["accessors"][root["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
view = root["bufferViews"][accessor["bufferView"]]
stored = np.frombuffer(binary, np.uint8, 4, view.get("byteOffset", 0) + accessor.get("byteOffset", 0))
share = stored[0] / 255
shown = round(255 * (1.055 * share ** (1 / 2.4) - 0.055))
print("trimesh", trimesh.__version__)
print("COLOR_0:", stored.tolist(), "component type", accessor["componentType"])
print("a viewer that keeps to glTF shows", shown, "for 128; linear 128 is", round(255 * ((128 / 255 + 0.055) / 1.055) ** 2.4))
assert stored[:3].tolist() == [128, 128, 128] and shown == 188, "the behaviour has changed"
PYTHON
