"""Levels of detail: the same scene from fewer splats, for cameras that see it from afar."""

from collections.abc import Mapping

from surfkit.compress.levels.base import LevelsOfDetail
from surfkit.compress.levels.hierarchy import Hierarchy
from surfkit.compress.levels.merged_levels import MergedLevels
from surfkit.compress.levels.pruned_levels import PrunedLevels
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    return {"hierarchy": Hierarchy, "merge": MergedLevels, "prune": PrunedLevels}


__all__ = ["Hierarchy", "LevelsOfDetail", "MergedLevels", "PrunedLevels"]
