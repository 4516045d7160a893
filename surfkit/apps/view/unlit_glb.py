"""A coloured mesh for a browser: GLB whose colours are shown as they are, without light, from both sides."""

from __future__ import annotations

import numpy as np

from surfkit.io.glb import FLOAT, INDICES, UNLIT, UNSIGNED_INT, VERTICES, GlbWriter, glb, linear_colors
from surfkit.mesh.base import Mesh


def unlit_glb(mesh: Mesh) -> bytes:
    """A mesh with colours; they are photographs' and have their light in them."""
    assert mesh.colors is not None
    places, faces = np.ascontiguousarray(mesh.vertices, "<f4"), np.ascontiguousarray(mesh.faces, "<u4")
    colors, blocks = linear_colors(mesh.colors), GlbWriter()
    view = blocks.add(places.nbytes, places.tobytes, target=VERTICES)
    ends = {"min": places.min(0).tolist(), "max": places.max(0).tolist()}
    position = blocks.accessor(view, count=len(places), componentType=FLOAT, type="VEC3", **ends)
    view = blocks.add(colors.nbytes, colors.tobytes, target=VERTICES)
    color = blocks.accessor(view, count=len(places), componentType=FLOAT, type="VEC3")
    view = blocks.add(faces.nbytes, faces.tobytes, target=INDICES)
    indices = blocks.accessor(view, count=faces.size, componentType=UNSIGNED_INT, type="SCALAR")
    attributes = {"POSITION": position, "COLOR_0": color}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [{"doubleSided": True, "extensions": {UNLIT: {}}}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
    }
    return b"".join(glb("the mesh", document, blocks, "show fewer triangles"))
