"""Who does the work on the blocks of a large scene."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.runs.execute.base import Inline, Pool
from surfkit.runs.execute.ray import Ray
from surfkit.runs.execute.slurm import Slurm


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    return {"inline": Inline, "pool": Pool, "ray": Ray, "slurm": Slurm}
