"""Estimators of depth, by the name users type."""

from surfkit.core.registry import hookimpl
from surfkit.depth.plane_sweep import PlaneSweep


@hookimpl
def surfkit_components():
    return {"plane-sweep": PlaneSweep}
