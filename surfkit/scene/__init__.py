"""Layouts of data sets, by the name users type."""

from surfkit.core.registry import hookimpl


@hookimpl
def surfkit_components():
    from surfkit.scene.colmap import COLMAP
    from surfkit.scene.opensfm import ODM
    from surfkit.scene.transforms import Blender, MatrixCity, Nerfstudio

    return {"blender": Blender, "colmap": COLMAP, "matrixcity": MatrixCity, "nerfstudio": Nerfstudio, "odm": ODM}
