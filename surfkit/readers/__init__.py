"""Data sets: their layouts, the layouts of their depth maps, and rules of which photographs are held out."""

from surfkit.core.registry import hookimpl


@hookimpl
def surfkit_components():
    from surfkit.readers.colmap import COLMAP
    from surfkit.readers.depth_layouts import EstimatedDepths, HierarchicalDepths, MatrixCityDepths, NerfstudioDepths
    from surfkit.readers.opensfm import ODM
    from surfkit.readers.split import GauUScene
    from surfkit.readers.transforms import Blender, MatrixCity, Nerfstudio

    readers = {"blender": Blender, "colmap": COLMAP, "matrixcity": MatrixCity, "nerfstudio": Nerfstudio, "odm": ODM}
    depths = {
        "estimated-depths": EstimatedDepths,
        "hierarchical-3dgs": HierarchicalDepths,
        "matrixcity-depths": MatrixCityDepths,
        "nerfstudio-depths": NerfstudioDepths,
    }
    return readers | depths | {"gauu-scene": GauUScene}
