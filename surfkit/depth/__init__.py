"""Depth estimators and what fills their holes, by registered name."""

from surfkit.core.hooks import hookimpl
from surfkit.depth.depth_anything import DepthAnythingV2
from surfkit.depth.fill_monocular import MonocularFill
from surfkit.depth.fill_planes import PlaneFill
from surfkit.depth.filled import Filled
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep


@hookimpl
def surfkit_components():
    estimators = {"patch-match": PatchMatch, "plane-sweep": PlaneSweep, "depth-anything-v2": DepthAnythingV2}
    return estimators | {"filled": Filled, "planes": PlaneFill, "monocular": MonocularFill}
