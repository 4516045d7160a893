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
from surfkit.train.material import Store

BARE, HELD, ANEW = 1, 2, 3


@dataclass(frozen=True)
class Rung:
    """One step down.

    Attributes:
        number: Counted from 1.
        text: What is done, as the end of a sentence.
    """

    number: int
    text: str


LADDER = (
    Rung(BARE, "photographs are not kept in memory, which takes longer and leaves the result as it is"),
    Rung(HELD, "it goes on with no more points than it has in its last checkpoint"),
    Rung(ANEW, "it begins anew, and with no more points than it begins with"),
)


def following(state: BlockState, densify: Densify | None) -> Rung | None:
    """The rung after the one that a block is on; None if there is nothing more that would need less.

    Args:
        state: Of the block.
        densify: How its points multiply.
    """
    rung = LADDER[state.rung] if state.rung < len(LADDER) else None
    if rung is None or (rung.number > BARE and densify is None):
        return None
    if rung.number == ANEW and (state.most_points or 0) <= state.begun_points:
        return None  # it has not grown
    return rung


def climb(block: Run) -> None:
    """Put a block on its next rung if memory gave out when it was last worked on, and say so."""
    state = read_state(block.out)
    rung = following(state, block.recipe.tune.densify) if state.kind == "oom" else None
    if rung is None:
        return
    most, text = state.most_points, "photographs not kept in memory"
    if rung.number == HELD:
        found = checkpoint.load_last(block.checkpoint)
        step, most = (found[0].index, len(found[0].points)) if found else (0, max(1, state.begun_points))
        text = f"at most {most:,} points from step {step:,} on"
    elif rung.number == ANEW:
        checkpoint.discard(block.checkpoint)
        most, text = state.begun_points, f"begun anew, at most {state.begun_points:,} points"
    emit(Warned(f"for want of memory: {text}"))
    write_state(
        block.out,
        status="planned",
        kind=None,
        error=None,
        rung=rung.number,
        most_points=most,
        eased=(*state.eased, text),
    )


def eased(block: Run, store: Store) -> tuple[Run, Store]:
    """A block, and where its photographs are kept, as its rung has them."""
    state = read_state(block.out)
    if state.rung >= BARE:
        store = replace(store, cache="0")
    tune = block.recipe.tune
    if state.most_points is not None and tune.densify is not None:
        tune = replace(tune, densify=capped(tune.densify, state.most_points))
        block = replace(block, recipe=replace(block.recipe, tune=tune))
    return block, store


def capped(densify: Densify, points: int) -> Densify | None:
    """A way to densify that goes up to a number of points; None where it knows no such number."""
    known = {field.name for field in fields(densify)}
    if "cap" in known:
        return replace(densify, cap=min(densify.cap, points))
    if "filters" in known:
        return replace(densify, filters=(*densify.filters, CountCap(points)))
    return None


def lesser(state: BlockState) -> str | None:
    """In what the result of a block is less than its recipe wants; None if it is not."""
    return state.eased[-1] if state.rung >= HELD else None
