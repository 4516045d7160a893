"""What follows the merge of the blocks: the whole model optimised once more, to become smaller or more accurate."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.train.refine.base import Refine
from surfkit.train.refine.light_gaussian import DistilSH, PruneAndRecover
from surfkit.train.refine.rendered_depth import RenderedDepth


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    return {"recover": PruneAndRecover, "distil": DistilSH, "rendered-depth": RenderedDepth}


__all__ = ["Distil", "Recover", "Refine"]
