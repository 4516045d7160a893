"""Which maps the terms of a stage look at."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from surfkit.losses.base import Loss, Regularizer
from surfkit.train.setup import StageSetup

GEOMETRY_MAPS = {"depth", "median", "normal", "distortion"}
"""Maps beyond the colours."""


def maps_of_step(setup: StageSetup, index: int) -> dict[str, str]:
    """By the name of a map that the terms of step `index` read, the path of one of these terms."""
    stage, steps = setup.stage, [index]
    if index == 1 and setup.draws is not setup.rasterizer:
        # what a render of the primitive's own lacks for the last steps is told now, not after hours
        steps += [max(1, stage.steps + at) for at in range(-99, 1)]
    return maps_read(stage.losses, stage.regularizers, steps, stage.steps)


def maps_read(
    losses: Mapping[str, Loss], regularizers: Mapping[str, Regularizer], indices: Iterable[int], steps: int
) -> dict[str, str]:
    """By the name of a map that is read in one of some steps, the path of a term that reads it.

    Args:
        losses: By key.
        regularizers: By key.
        indices: Steps, 1 to `steps`.
        steps: Of the stage.
    """
    groups: dict[str, Mapping[str, Loss | Regularizer]] = {"losses": losses, "regularizers": regularizers}
    found: dict[str, str] = {}
    for index in indices:
        for group, terms in groups.items():
            for name, term in terms.items():
                if term.weight_at(index, steps) > 0:
                    # the neighbour of a pair is chosen by the median depth
                    paired = isinstance(term, Loss) and term.needs_neighbour
                    found |= dict.fromkeys((*term.reads, *["median"] * paired), f"{group}.{name}")
    return found
