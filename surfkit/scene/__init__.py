"""Layouts of data sets, by the name users type."""

from surfkit.core.registry import hookimpl


@hookimpl
def surfkit_components():
    from surfkit.scene.colmap import COLMAP

    return {"colmap": COLMAP}
