"""How a block is trained again after it ran out of memory: with one fallback after the other.

The number of the fallback is in the state of the block, so that later attempts keep it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from surfkit.core.events import Warned, emit
from surfkit.densify.base import Densify
from surfkit.runs.blocks.block import BlockRun
from surfkit.runs.execute.block_state import BlockState
from surfkit.runs.folder import RunStage
from surfkit.train import checkpoint
from surfkit.train.data_cache import CacheSettings

NO_CACHE, NO_GROWTH, START_AGAIN = 1, 2, 3


@dataclass(frozen=True)
class Fallback:
    """One way to need less memory.

    Attributes:
        number: Counted from 1, in the order in which they are used.
        text: What is done, as the end of a sentence.
    """

    number: int
    text: str


FALLBACKS = (
    Fallback(NO_CACHE, "photographs are not kept in memory, which is slower and does not change the result"),
    Fallback(NO_GROWTH, "it continues with no more points than in its last checkpoint"),
    Fallback(START_AGAIN, "it starts again, with no more points than it starts with"),
)


def next_fallback(state: BlockState, densify: Densify | None) -> Fallback | None:
    """The fallback after those that a block has used; None if no other needs less memory.

    Args:
        state: Of the block.
        densify: How points are added to it.
    """
    fallback = FALLBACKS[state.fallback] if state.fallback < len(FALLBACKS) else None
    if fallback is None or (fallback.number > NO_CACHE and densify is None):
        return None
    if fallback.number == START_AGAIN and (state.most_points or 0) <= state.begun_points:
        return None  # no point was added
    return fallback


def take_fallback(block: BlockRun) -> None:
    """Use the next fallback if the block ran out of memory when it was last trained, with a warning."""
    state, path = block.state, block.stage.checkpoint
    fallback = next_fallback(state, block.run.recipe.tune.densify) if block.is_out_of_memory else None
    if fallback is None:
        return
    most, text = state.most_points, "photographs not kept in memory"
    if fallback.number == NO_GROWTH:
        found = checkpoint.load_last(path)
        step, most = (found[0].index, len(found[0].points)) if found else (0, max(1, state.begun_points))
        text = f"at most {most:,} points from step {step:,} on"
    elif fallback.number == START_AGAIN:
        checkpoint.discard(path)
        most, text = state.begun_points, f"started again, at most {state.begun_points:,} points"
    emit(Warned(f"after running out of memory: {text}"))
    reduced = (*state.reduced, text)
    block.write(status="planned", kind=None, error=None, fallback=fallback.number, most_points=most, reduced=reduced)


def apply_fallback(block: BlockRun, caches: CacheSettings) -> tuple[RunStage, CacheSettings]:
    """The stage of a block and the settings of its caches, as changed by the fallbacks it has used."""
    state, stage = block.state, block.stage
    if state.fallback >= NO_CACHE:
        caches = replace(caches, cache="0", gpu="0")
    tune = stage.stage
    if state.most_points is not None and tune.densify is not None:
        stage = replace(stage, stage=replace(tune, densify=tune.densify.limited(state.most_points)))
    return stage, caches


def reduction(state: BlockState) -> str | None:
    """In what the result of a block is less than its recipe says, for lack of memory; None if it is not."""
    return state.reduced[-1] if state.fallback >= NO_GROWTH else None
