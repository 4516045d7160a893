"""What a block is tuned with when memory has given out: less and less, one rung after the other.

The rung stands in the block's state, so that whoever comes back to the block goes on from there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from surfkit.core.events import Warned, emit
from surfkit.densify.base import Densify
from surfkit.densify.filters import CountCap
from surfkit.execute.state import BlockState, read_state, write_state
from surfkit.run.folder import Run
from surfkit.train import checkpoint
from surfkit.train.material import CacheSettings

NO_CACHE, NO_GROWTH, START_AGAIN = 1, 2, 3


@dataclass(frozen=True)
class Fallback:
    """One step down.

    Attributes:
        number: ViewCounts from 1.
        text: What is done, as the end of a sentence.
    """

    number: int
    text: str


FALLBACKS = (
    Fallback(NO_CACHE, "photographs are not kept in memory, which takes longer and leaves the result as it is"),
    Fallback(NO_GROWTH, "it goes on with no more points than it has in its last checkpoint"),
    Fallback(START_AGAIN, "it begins anew, and with no more points than it begins with"),
)


def next_fallback(state: BlockState, densify: Densify | None) -> Fallback | None:
    """The rung after the one that a block is on; None if there is nothing more that would need less.

    Args:
        state: Of the block.
        densify: How its points multiply.
    """
    fallback = FALLBACKS[state.fallback] if state.fallback < len(FALLBACKS) else None
    if fallback is None or (fallback.number > NO_CACHE and densify is None):
        return None
    if fallback.number == START_AGAIN and (state.most_points or 0) <= state.begun_points:
        return None  # it has not grown
    return fallback


def take_fallback(block: Run) -> None:
    """Put a block on its next rung if memory gave out when it was last worked on, and say so."""
    state = read_state(block.out)
    fallback = next_fallback(state, block.recipe.tune.densify) if state.kind == "oom" else None
    if fallback is None:
        return
    most, text = state.most_points, "photographs not kept in memory"
    if fallback.number == NO_GROWTH:
        found = checkpoint.load_last(block.checkpoint)
        step, most = (found[0].index, len(found[0].points)) if found else (0, max(1, state.begun_points))
        text = f"at most {most:,} points from step {step:,} on"
    elif fallback.number == START_AGAIN:
        checkpoint.discard(block.checkpoint)
        most, text = state.begun_points, f"begun anew, at most {state.begun_points:,} points"
    emit(Warned(f"for want of memory: {text}"))
    write_state(
        block.out,
        status="planned",
        kind=None,
        error=None,
        fallback=fallback.number,
        most_points=most,
        reduced=(*state.reduced, text),
    )


def reduced(block: Run, caches: CacheSettings) -> tuple[Run, CacheSettings]:
    """A block, and where its photographs are kept, as its rung has them."""
    state = read_state(block.out)
    if state.fallback >= NO_CACHE:
        caches = replace(caches, cache="0")
    tune = block.recipe.tune
    if state.most_points is not None and tune.densify is not None:
        tune = replace(tune, densify=capped(tune.densify, state.most_points))
        block = replace(block, recipe=replace(block.recipe, tune=tune))
    return block, caches


def capped(densify: Densify, points: int) -> Densify | None:
    """A way to densify that goes up to a number of points; None where it knows no such number."""
    known = {field.name for field in fields(densify)}
    if "cap" in known:
        return replace(densify, cap=min(densify.cap, points))
    if "filters" in known:
        return replace(densify, filters=(*densify.filters, CountCap(points)))
    return None


def shortfall(state: BlockState) -> str | None:
    """In what the result of a block is less than its recipe wants; None if it is not."""
    return state.reduced[-1] if state.fallback >= NO_GROWTH else None
