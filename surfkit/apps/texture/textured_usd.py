"""A textured mesh as OpenUSD: a mesh and a UsdPreviewSurface for each page, in one .usdz file.

Source: https://openusd.org/release/spec_usdpreviewsurface.html. Texture coordinates begin in the lower left corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.texture.obj_glb import AtlasPageMesh, Place
from surfkit.io.usdz import new_stage, place_prim, write_usdz
from surfkit.mesh.base import Mesh

ROOT = "/textured"


def write_textured_usdz(
    path: Path,
    mesh: Mesh,
    parts: Sequence[AtlasPageMesh],
    pages: Sequence[Path],
    place: Place,
    turn: np.ndarray,
    metres: float | None,
    notes: dict[str, Any],
) -> None:
    """Write a .usdz file with its pages in it.

    Args:
        path: Appears only when it is complete.
        mesh: The mesh.
        parts: The triangles of each page.
        pages: Files of the pages.
        place: From local coordinates to those of the file.
        turn: (3, 3) from these to z up, which the root has.
        metres: Per unit; None if unknown.
        notes: What the custom data of the layer says.

    Raises:
        BadInput: More than 4 GiB.
    """
    from pxr import UsdGeom

    stage = new_stage("Z", metres, notes)
    root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    place_prim(root, matrix)
    for number, (part, page) in enumerate(zip(parts, pages, strict=True)):
        places = place(mesh.vertices[part.vertices])
        _add_part(stage, f"{ROOT}/page{number}", places, part, page.name, f"texture_{number}")
    write_usdz(path, stage, pages)


def _add_part(stage: Any, path: str, places: np.ndarray, part: AtlasPageMesh, texture: str, name: str) -> None:
    """The mesh of a page with (V, 3) coordinates of its vertices, and its material, which has a name of its own."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    points = np.ascontiguousarray(places, np.float32)
    made = UsdGeom.Mesh.Define(stage, path)
    made.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(part.faces), 3, np.int32)))
    made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(part.faces.ravel()))
    made.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
    made.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)  # not a control cage of a smooth surface
    made.CreateDoubleSidedAttr(True)
    kind = Sdf.ValueTypeNames
    uv = UsdGeom.PrimvarsAPI(made).CreatePrimvar("st", kind.TexCoord2fArray, UsdGeom.Tokens.vertex)
    uv.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(part.uv * [1, -1] + [0, 1], np.float32)))

    material = UsdShade.Material.Define(stage, f"{path}/{name}")
    surface, reader, image = (
        UsdShade.Shader.Define(stage, f"{path}/{name}/{each}") for each in ("surface", "reader", "image")
    )
    for shader, what in ((surface, "UsdPreviewSurface"), (reader, "UsdPrimvarReader_float2"), (image, "UsdUVTexture")):
        shader.CreateIdAttr(what)
    reader.CreateInput("varname", kind.String).Set("st")
    for key, type_name, value in (
        ("file", kind.Asset, texture),
        ("sourceColorSpace", kind.Token, "sRGB"),
        ("wrapS", kind.Token, "clamp"),
        ("wrapT", kind.Token, "clamp"),
    ):
        image.CreateInput(key, type_name).Set(value)
    image.CreateInput("st", kind.Float2).ConnectToSource(reader.CreateOutput("result", kind.Float2))
    color = surface.CreateInput("diffuseColor", kind.Color3f)
    color.ConnectToSource(image.CreateOutput("rgb", kind.Float3))
    surface.CreateInput("roughness", kind.Float).Set(1.0)
    surface.CreateInput("metallic", kind.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kind.Token))
    UsdShade.MaterialBindingAPI.Apply(made.GetPrim()).Bind(material)
