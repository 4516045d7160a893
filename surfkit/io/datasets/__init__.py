"""Data sets: their layouts, the layouts of their depth maps, and rules of which photographs are held out."""

from surfkit.core.hooks import hookimpl


@hookimpl
def surfkit_components():
    from surfkit.io.datasets.blocks_exchange import BlocksExchange
    from surfkit.io.datasets.bundler import Bundler
    from surfkit.io.datasets.colmap import COLMAP
    from surfkit.io.datasets.depth_layouts import (
        EstimatedDepths,
        HierarchicalDepths,
        MatrixCityDepths,
        NerfstudioDepths,
    )
    from surfkit.io.datasets.metashape import Metashape
    from surfkit.io.datasets.openmvg import OpenMVG
    from surfkit.io.datasets.opensfm import ODM
    from surfkit.io.datasets.opf import OPF
    from surfkit.io.datasets.pix4d import Pix4D
    from surfkit.io.datasets.polycam import Polycam, PolycamDepths
    from surfkit.io.datasets.realitycapture import RealityCapture
    from surfkit.io.datasets.record3d import Record3D
    from surfkit.io.datasets.split import GauUScene
    from surfkit.io.datasets.transforms import Blender, MatrixCity, Nerfstudio
    from surfkit.io.datasets.xmp_sidecars import XmpSidecars

    readers = {
        "blender": Blender,
        "blocks-exchange": BlocksExchange,
        "bundler": Bundler,
        "colmap": COLMAP,
        "matrixcity": MatrixCity,
        "metashape": Metashape,
        "nerfstudio": Nerfstudio,
        "odm": ODM,
        "openmvg": OpenMVG,
        "opf": OPF,
        "pix4d": Pix4D,
        "polycam": Polycam,
        "realitycapture": RealityCapture,
        "record3d": Record3D,
        "xmp-sidecars": XmpSidecars,
    }
    depths = {
        "estimated-depths": EstimatedDepths,
        "hierarchical-3dgs": HierarchicalDepths,
        "matrixcity-depths": MatrixCityDepths,
        "nerfstudio-depths": NerfstudioDepths,
        "polycam-depths": PolycamDepths,
    }
    return readers | depths | {"gauu-scene": GauUScene}
