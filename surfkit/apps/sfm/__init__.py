"""Structure from motion: a folder of photographs becomes a data set with cameras and points, on the map."""

from surfkit.apps.sfm.kornia_features import ALIKED, DISK, KorniaSIFT
from surfkit.apps.sfm.lightglue import LightGlue
from surfkit.apps.sfm.mutual import Mutual
from surfkit.apps.sfm.sift import SIFT, PyCOLMAP
from surfkit.core.hooks import hookimpl


@hookimpl
def surfkit_components():
    features = {"sift": SIFT, "kornia-sift": KorniaSIFT, "disk": DISK, "aliked": ALIKED}
    return features | {"pycolmap": PyCOLMAP, "mutual": Mutual, "lightglue": LightGlue}
