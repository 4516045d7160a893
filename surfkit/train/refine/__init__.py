"""What follows the merge of the blocks: the whole model optimised once more, to become smaller."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.train.refine.base import Refine
from surfkit.train.refine.light_gaussian import DistilSH, PruneAndRecover


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    return {"recover": PruneAndRecover, "distil": DistilSH}


__all__ = ["Distil", "Recover", "Refine"]
