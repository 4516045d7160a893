"""Depth estimators, by registered name."""

from surfkit.core.hooks import hookimpl
from surfkit.depth.depth_anything import DepthAnythingV2
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep


@hookimpl
def surfkit_components():
    return {"patch-match": PatchMatch, "plane-sweep": PlaneSweep, "depth-anything-v2": DepthAnythingV2}
