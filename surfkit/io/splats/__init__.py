"""Files that other programs read: formats of splats, points and cameras."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    from surfkit.io.splats.compressed_ply import CompressedPLY
    from surfkit.io.splats.gltf import GLTF
    from surfkit.io.splats.page import HtmlPageFormat
    from surfkit.io.splats.ply import PLY
    from surfkit.io.splats.sog import SOG
    from surfkit.io.splats.splat import Splat
    from surfkit.io.splats.spz import SPZ
    from surfkit.io.splats.streamed_sog import StreamedSOG
    from surfkit.io.splats.tiles3d import Tiles3D
    from surfkit.io.splats.usd import USD

    return {
        "compressed-ply": CompressedPLY,
        "gltf": GLTF,
        "page": HtmlPageFormat,
        "ply": PLY,
        "sog": SOG,
        "splat": Splat,
        "spz": SPZ,
        "streamed-sog": StreamedSOG,
        "tiles3d": Tiles3D,
        "usd": USD,
    }
