"""Data sets: their layouts, the layouts of their depth maps, and rules of which photographs are held out."""

from surfkit.core.registry import hookimpl


@hookimpl
def surfkit_components():
    from surfkit.readers.blocks_exchange import BlocksExchange
    from surfkit.readers.bundler import Bundler
    from surfkit.readers.colmap import COLMAP
    from surfkit.readers.depth_layouts import EstimatedDepths, HierarchicalDepths, MatrixCityDepths, NerfstudioDepths
    from surfkit.readers.metashape import Metashape
    from surfkit.readers.openmvg import OpenMVG
    from surfkit.readers.opensfm import ODM
    from surfkit.readers.opf import OPF
    from surfkit.readers.pix4d import Pix4D
    from surfkit.readers.polycam import Polycam, PolycamDepths
    from surfkit.readers.realitycapture import RealityCapture
    from surfkit.readers.record3d import Record3D
    from surfkit.readers.split import GauUScene
    from surfkit.readers.transforms import Blender, MatrixCity, Nerfstudio
    from surfkit.readers.xmp_sidecars import XmpSidecars

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
