"""Files that other programs read: formats of splats, points and cameras."""

from collections.abc import Mapping

from surfkit.core.registry import Component, hookimpl


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    from surfkit.export.compressed_ply import CompressedPLY
    from surfkit.export.gltf import GLTF
    from surfkit.export.page import Page
    from surfkit.export.ply import PLY
    from surfkit.export.sog import SOG
    from surfkit.export.splat import Splat
    from surfkit.export.spz import SPZ
    from surfkit.export.tiles3d import Tiles3D

    return {
        "compressed-ply": CompressedPLY,
        "gltf": GLTF,
        "page": Page,
        "ply": PLY,
        "sog": SOG,
        "splat": Splat,
        "spz": SPZ,
        "tiles3d": Tiles3D,
    }
