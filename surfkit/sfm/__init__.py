"""Structure from motion: a folder of photographs becomes a data set with cameras and points, on the map."""

from surfkit.core.registry import hookimpl
from surfkit.sfm.learnt import ALIKED, DISK, KorniaSIFT
from surfkit.sfm.lightglue import LightGlue
from surfkit.sfm.mutual import Mutual
from surfkit.sfm.sift import SIFT, PyCOLMAP


@hookimpl
def surfkit_components():
    features = {"sift": SIFT, "kornia-sift": KorniaSIFT, "disk": DISK, "aliked": ALIKED}
    return features | {"pycolmap": PyCOLMAP, "mutual": Mutual, "lightglue": LightGlue}
