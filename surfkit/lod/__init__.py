"""Levels of detail: the same scene from fewer splats, for cameras that see it from afar."""

from collections.abc import Mapping

from surfkit.core.registry import Component, hookimpl
from surfkit.lod.base import LevelsOfDetail
from surfkit.lod.merge import MergedLevels
from surfkit.lod.prune import PrunedLevels


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    return {"merge": MergedLevels, "prune": PrunedLevels}


__all__ = ["LevelsOfDetail", "MergedLevels", "PrunedLevels"]
