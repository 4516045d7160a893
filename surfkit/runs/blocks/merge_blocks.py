"""Merging: the results of all blocks as one state, without holding all of them in memory at once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.codec import write_json
from surfkit.core.events import FileWritten, Warned, emit
from surfkit.partition.merge import BlockContribution, Merge, Pieces
from surfkit.primitives.points import Columns, Points
from surfkit.runs.blocks.block import BlockRun, consensus_of
from surfkit.runs.blocks.oom_retry import reduction
from surfkit.runs.blocks.rounds import AgreedMerge, finished_piece
from surfkit.runs.context import RunContext
from surfkit.runs.photo_light import light_of
from surfkit.train import checkpoint, streaming
from surfkit.train.image_appearance import first_appearances
from surfkit.train.stage import Stage
from surfkit.train.state import StageState
from surfkit.train.streaming import StoredState
from surfkit.train.view_order import ViewOrder


def merge_blocks(ctx: RunContext, blocks: Sequence[BlockRun], coarse: StoredState) -> bool:
    """Write all blocks as one state, each point from its owner; where nothing was trained, from the coarse model.

    False if a result is not what its state says; that block is to be trained again.
    """
    recipe, path = ctx.run.recipe, ctx.run.merged.checkpoint
    skipped = frozenset(block.index for block in blocks if not block.planned.views)
    results = {block.index: open_result(block, recipe.tune.steps) for block in blocks if block.index not in skipped}
    found = {index: result for index, result in results.items() if result is not None}
    if len(found) < len(results):
        return False
    trained = {index: finished(recipe.tune, result) for index, result in found.items()}
    merge: Merge | AgreedMerge = Merge(blocks[0].plan.cells, finished(recipe.pretrain, coarse), trained, skipped)
    if consensus_of(recipe) is not None:
        merge = AgreedMerge(blocks, coarse, found)
    shares = merge.shares()
    write_shares(blocks, shares)
    parts = [result.state for result in (coarse, *found.values())]
    state = merged_state(ctx, parts, shares)
    if (other := ctx.run.partition) is not None and (decided := streaming.open_last(other.pretrain.checkpoint)):
        state.seconds += decided[0].state.seconds
        state.cpu_seconds += decided[0].state.cpu_seconds
    streaming.save(path, state, merge.pieces())
    emit(FileWritten(path, "merged blocks"))
    return True


def finished(stage: Stage, stored: StoredState) -> Pieces:
    """The points of a state as they leave its stage."""
    return lambda: (finished_piece(stage, piece) for piece in stored.pieces())


def merged_state(ctx: RunContext, parts: Sequence[StageState], shares: Sequence[BlockContribution]) -> StageState:
    """The state of the merged blocks but for the values of its points; `parts` are the coarse model and the blocks."""
    recipe, points = ctx.run.recipe, sum(share.kept for share in shares)
    like = parts[0].points.params
    params = {
        name: torch.empty(points, *value.shape[1:], dtype=value.dtype, device="meta") for name, value in like.items()
    }
    order, generator = ViewOrder(len(ctx.scene.train)), torch.Generator().manual_seed(recipe.seed)
    state = StageState(
        Points(params, {}, {}, shared=shared_mean(parts, shares)), order, generator, index=recipe.tune.steps
    )
    state.seconds = sum(part.seconds for part in parts)
    state.cpu_seconds = sum(part.cpu_seconds for part in parts)
    state.peak_memory_bytes = max(part.peak_memory_bytes for part in parts)
    state.peak_gpu_bytes = max(part.peak_gpu_bytes for part in parts)
    state.sh_degree = max(part.sh_degree for part in parts)
    if (model := recipe.tune.appearance) is not None:  # what blocks learned is folded into their colours
        views = ctx.scene.train
        light = light_of(ctx.run, views) if model.needs_light else None
        state.appearances = first_appearances(model, len(views), light)
    return state


def shared_mean(parts: Sequence[StageState], shares: Sequence[BlockContribution]) -> Columns:
    """Parameters that belong to no point: their mean over the trained blocks, weighted by the points each gives.

    `parts` are the coarse model and the trained blocks, in the order of the shares that the coarse model did not fill.
    """
    trained = [share.kept for share in shares if not share.filled]
    weights, total = (trained, sum(trained)) if sum(trained) else ([1] * len(trained), len(trained))
    coarse, *blocks = [part.points.shared for part in parts]
    if not blocks:
        return coarse

    def mean(name: str, like: Tensor) -> Tensor:
        parts = (block[name].double() * weight for block, weight in zip(blocks, weights, strict=True))
        return (sum(parts, like.new_zeros((), dtype=torch.float64)) / total).to(like)

    return {name: mean(name, value) for name, value in coarse.items()}


def open_result(block: BlockRun, steps: int) -> StoredState | None:
    """The state of a block after some steps; None, and the block planned again, if it is damaged or has not as many."""
    path = block.stage.checkpoint
    try:
        found = streaming.open_last(path)
    except BadInput as error:
        emit(Warned(f"block {block.index} is tuned from its beginning again: {error}"))
        checkpoint.discard(path)
        found = None
    step = found[0].state.index if found else 0
    if found is not None and step >= steps:
        return found[0]
    emit(Warned(f"block {block.index} has lost steps: its checkpoint is of {step}, not of {steps}"))
    block.write(status="planned", step=step)
    return None


def write_shares(blocks: Sequence[BlockRun], shares: Sequence[BlockContribution]) -> None:
    """Write merge.json; warn of blocks that were reduced for lack of memory, and of those without views."""
    write_json(blocks[0].run.blocks / "merge.json", {"blocks": shares, "points": sum(share.kept for share in shares)})
    for share in shares:
        less = reduction(blocks[share.index].state)
        if less and not share.filled:
            emit(Warned(f"block {share.index} was tuned with less than the recipe says, as memory ran out: {less}"))
    if filled := [str(share.index) for share in shares if share.filled]:
        emit(Warned(f"blocks {', '.join(filled)} have no views, and are as they were in the coarse model"))
