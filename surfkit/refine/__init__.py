"""What follows the merge of the blocks: the whole model optimised once more, to become smaller."""

from collections.abc import Mapping

from surfkit.core.registry import Component, hookimpl
from surfkit.refine.base import Refine
from surfkit.refine.light import Distil, Recover


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    return {"recover": Recover, "distil": Distil}


__all__ = ["Distil", "Recover", "Refine"]
