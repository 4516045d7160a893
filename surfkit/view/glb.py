"""A coloured mesh for a browser: GLB whose colours are shown as they are, without light, from both sides."""

from __future__ import annotations

import json
import struct

import numpy as np

from surfkit.export.glb import FLOAT, SHORT, VERTICES, linear_colors
from surfkit.mesh.base import Mesh

CORNERS = 34963
INT = 5125
"""Numbers of glTF: targets of buffers, and types of values."""
UNLIT = "KHR_materials_unlit"


def unlit_glb(mesh: Mesh) -> bytes:
    """A mesh with colours; they are photographs' and have their light in them."""
    assert mesh.colors is not None
    places = np.ascontiguousarray(mesh.vertices, "<f4")
    parts = [places.tobytes(), linear_colors(mesh.colors).tobytes(), np.ascontiguousarray(mesh.faces, "<u4").tobytes()]
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    views = [{"target": VERTICES}, {"target": VERTICES}, {"target": CORNERS}]
    accessors = [
        {"componentType": FLOAT, "type": "VEC3", "min": places.min(0).tolist(), "max": places.max(0).tolist()},
        {"componentType": SHORT, "type": "VEC4", "normalized": True},
        {"componentType": INT, "type": "SCALAR"},
    ]
    counts = [len(places), len(places), mesh.faces.size]
    attributes = {"POSITION": 0, "COLOR_0": 1}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [{"doubleSided": True, "extensions": {UNLIT: {}}}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2, "material": 0}]}],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": len(part), **view}
            for start, part, view in zip(starts, parts, views, strict=False)
        ],
        "accessors": [{"bufferView": at, "count": counts[at], **kind} for at, kind in enumerate(accessors)],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + starts[-1])
    return b"".join(
        [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", starts[-1], b"BIN\0"), *parts]
    )
