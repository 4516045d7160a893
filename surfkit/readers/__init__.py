"""Layouts of data sets, by the name users type."""

from surfkit.core.registry import hookimpl


@hookimpl
def surfkit_components():
    from surfkit.readers.colmap import COLMAP
    from surfkit.readers.opensfm import ODM
    from surfkit.readers.transforms import Blender, MatrixCity, Nerfstudio

    return {"blender": Blender, "colmap": COLMAP, "matrixcity": MatrixCity, "nerfstudio": Nerfstudio, "odm": ODM}
