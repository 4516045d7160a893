"""Blocks put together: the results of all of them as one state, without holding them all at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from surfkit.blocks.oom_retry import shortfall
from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.events import FileWritten, Warned, emit
from surfkit.execute.state import read_state, write_state
from surfkit.partition.merge import Merge, Pieces, Share
from surfkit.partition.plan import Plan
from surfkit.primitives.points import Columns, Points
from surfkit.run.context import RunContext
from surfkit.train import checkpoint
from surfkit.train import streaming as pieces
from surfkit.train.look import fresh_looks
from surfkit.train.stage import Stage, StageState
from surfkit.train.streaming import Stored
from surfkit.train.views import Order


def put_together(ctx: RunContext, blocks: Plan, coarse: Stored) -> bool:
    """Write all blocks as one state, each point from its owner; where nothing was tuned, from the coarse model.

    False if a result is not what its state says; that block is planned again.
    """
    recipe, final = ctx.run.recipe, replace(ctx.run, part="tune")
    skipped = frozenset(block.index for block in blocks.blocks if not block.views)
    results = {index: sound(ctx, index) for index in range(len(blocks.blocks)) if index not in skipped}
    found = {index: result for index, result in results.items() if result is not None}
    if len(found) < len(results):
        return False
    tuned_pieces = {index: finished(recipe.tune, result) for index, result in found.items()}
    merge = Merge(blocks.cells, finished(recipe.pretrain, coarse), tuned_pieces, skipped)
    shares = merge.shares()
    note(ctx, shares)
    parts = [result.state for result in (coarse, *found.values())]
    pieces.save(final.checkpoint, together(ctx, parts, shares), merge.pieces())
    emit(FileWritten(final.checkpoint, "merged blocks"))
    return True


def finished(stage: Stage, stored: Stored) -> Pieces:
    """The points of a state as they leave its stage."""
    return lambda: (
        {name: value for name, value in stage.finished(piece).items() if name in piece.points.params}
        for piece in stored.pieces()
    )


def together(ctx: RunContext, parts: Sequence[StageState], shares: Sequence[Share]) -> StageState:
    """The state of the merged blocks but for the values of its points; `parts` are the coarse model and the blocks."""
    recipe, points = ctx.run.recipe, sum(share.kept for share in shares)
    like = parts[0].points.params
    params = {
        name: torch.empty(points, *value.shape[1:], dtype=value.dtype, device="meta") for name, value in like.items()
    }
    order, generator = Order(len(ctx.scene.train)), torch.Generator().manual_seed(recipe.seed)
    state = StageState(
        Points(params, {}, {}, shared=shared_mean(parts, shares)), order, generator, index=recipe.tune.steps
    )
    state.seconds = sum(part.seconds for part in parts)
    state.cpu_seconds = sum(part.cpu_seconds for part in parts)
    state.peak_memory_bytes = max(part.peak_memory_bytes for part in parts)
    state.sh_degree = max(part.sh_degree for part in parts)
    if recipe.tune.appearance is not None:  # the blocks' own are folded into their colours
        state.looks = fresh_looks(recipe.tune.appearance, len(ctx.scene.train))
    return state


def shared_mean(parts: Sequence[StageState], shares: Sequence[Share]) -> Columns:
    """What belongs to no point: the mean over the blocks that were tuned, each weighted by the points that it gives.

    `parts` are the coarse model and the tuned blocks, in the order of those shares that the coarse model did not fill.
    """
    tuned = [share.kept for share in shares if not share.filled]
    weights, total = (tuned, sum(tuned)) if sum(tuned) else ([1] * len(tuned), len(tuned))
    coarse, *blocks = [part.points.shared for part in parts]
    if not blocks:
        return coarse
    return {
        name: sum(block[name].double() * weight for block, weight in zip(blocks, weights, strict=True))
        .div(total)
        .to(value)
        for name, value in coarse.items()
    }


def sound(ctx: RunContext, index: int) -> Stored | None:
    """The result of a block; None, and the block planned again, if it is damaged or has not all its steps."""
    path, steps = ctx.block(index).checkpoint, ctx.run.recipe.tune.steps
    try:
        found = pieces.open_last(path)
    except BadInput as error:
        emit(Warned(f"block {index} is tuned from its beginning again: {error}"))
        checkpoint.discard(path)
        found = None
    step = found[0].state.index if found else 0
    if found is not None and step >= steps:
        return found[0]
    emit(Warned(f"block {index} has lost steps: its checkpoint is of {step}, not of {steps}"))
    write_state(ctx.place(index), status="planned", step=step)
    return None


def note(ctx: RunContext, shares: Sequence[Share]) -> None:
    """Write down what each block gave, and say where the coarse model had to fill in."""
    write_json(ctx.folder / "merge.json", {"blocks": shares, "points": sum(share.kept for share in shares)})
    for share in shares:
        less = shortfall(read_state(ctx.place(share.index)))
        if less and not share.filled:
            emit(Warned(f"block {share.index} was tuned with less than the recipe says, for want of memory: {less}"))
    if filled := [str(share.index) for share in shares if share.filled]:
        emit(Warned(f"blocks {', '.join(filled)} have no views, and are as they were in the coarse model"))
