"""Blocks that agree on common points after every round (`Consensus`): what is agreed on is a file, and a block that has
come to the end of a round waits for it. So a block depends on its checkpoint and these files only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.core.files import replacing
from surfkit.partition.admm import ConsensusState, PointCopies, agree, columns_after, common, mean_copies
from surfkit.partition.merge import BlockContribution
from surfkit.primitives.points import Columns
from surfkit.runs.blocks.block import BlockRun, agreement_file, consensus_of, rounds_agreed
from surfkit.runs.folder import Run
from surfkit.train import checkpoint
from surfkit.train.stage import Stage
from surfkit.train.state import StageState
from surfkit.train.streaming import StoredState

ID, ROUND = "id", "consensus.round"
"""Columns of the points of a block: which point of the coarse model each is, and the last round whose agreement it has.
"""
KEPT_ROUND_FILES = 2
"""Files of rounds that are kept."""


def stops(block: BlockRun, done: int) -> Iterator[int]:
    """The steps at which the block is to stop from step `done` on: ends of rounds, as far as others have come."""
    rule, goal = consensus_of(block.run.recipe), block.goal
    every = rule.every if rule else goal
    for end in range((done // every + 1) * every, goal + every, every):
        yield min(end, goal)


def take_in(block: BlockRun, state: StageState | None) -> StageState | None:
    """The state with what was agreed on at its step, and saved so; as it is where there is nothing to take in.

    Raises:
        BadInput: What was agreed on there is not known any more.
    """
    rule = consensus_of(block.run.recipe)
    if state is None or rule is None or state.index % rule.every or state.index >= block.run.recipe.tune.steps:
        return state
    number, stats = state.index // rule.every, state.points.stats
    if number == 0 or (ROUND in stats and int(stats[ROUND][0]) >= number):
        return state
    found = load_agreement(block.run, number)
    if found is None:
        raise BadInput(
            f"block {block.index} goes on after step {state.index}, and {agreement_file(block.run, number)} is gone; "
            f"delete {block.run.blocks} to tune all blocks anew"
        )
    copies = PointCopies(stats[ID], state.points.params)
    stats = stats | columns_after(copies, stats, found, rule) | {ROUND: torch.full_like(stats[ID], number)}
    state.points = replace(state.points, stats=stats)
    checkpoint.save(block.stage.checkpoint, state)
    return state


def end_round(blocks: Sequence[BlockRun], results: Sequence[StoredState]) -> None:
    """Write what the blocks agree on at the end of a round, given their states there."""
    run = blocks[0].run
    rule, number = consensus_of(run.recipe), rounds_agreed(run) + 1
    assert rule is not None, "rounds end where blocks agree"
    before = load_agreement(run, number - 1) if number > 1 else None
    if number > 1 and before is None:
        raise BadInput(f"{agreement_file(run, number - 1)} is gone; delete {run.blocks} to tune all blocks anew")
    ids = common([stored.column(ID) for stored in results])
    found = agree([copies_of(stored, ids) for stored in results], rule, before, number * rule.every)
    save_agreement(agreement_file(run, number), found)
    agreement_file(run, number - KEPT_ROUND_FILES).unlink(missing_ok=True)
    say(f"round {number}: blocks agree on {len(found.ids):,} common points after step {number * rule.every:,}")


def copies_of(stored: StoredState, ids: Tensor) -> PointCopies:
    """Those among some points, (P,) int64, that a block has, without reading the others all at once."""
    own, parts = stored.column(ID), []
    kept = torch.isin(own, ids)
    begin = 0
    for piece in stored.pieces():
        rows = kept[begin : begin + len(piece.points)]
        begin += len(rows)
        parts.append({name: value[rows] for name, value in piece.points.params.items()})
    return PointCopies(own[kept], {name: torch.cat([part[name] for part in parts]) for name in parts[0]})


def save_agreement(path: Path, found: ConsensusState) -> None:
    """Write a file."""
    from safetensors.torch import save

    rho = {f"rho.{name}": torch.tensor(value, dtype=torch.float64) for name, value in found.rho.items()}
    tensors = {"ids": found.ids} | {f"z.{name}": value.contiguous() for name, value in found.z.items()} | rho
    with replacing(path) as file:
        file.write(save(tensors))


def load_agreement(run: Run, number: int) -> ConsensusState | None:
    """What was agreed on at the end of a round, counted from 1; None if there is no such file.

    Raises:
        BadInput: It is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    path = agreement_file(run, number)
    if not path.exists():
        return None
    try:
        tensors = load_file(path)
    except SafetensorError as error:
        raise BadInput(f"{path} is damaged; delete {run.blocks} to tune all blocks anew") from error
    z = {name.removeprefix("z."): value for name, value in tensors.items() if name.startswith("z.")}
    rho = {name: float(tensors[f"rho.{name}"]) for name in z}
    return ConsensusState(tensors["ids"], z, rho)


def finished_piece(stage: Stage, piece: StageState) -> Columns:
    """Raw parameters of some points as they leave a stage."""
    return {name: value for name, value in stage.finished(piece).items() if name in piece.points.params}


class AgreedMerge:
    """The merged model: of every point of the coarse model the mean of all copies, or the point itself if none has it.

    Args:
        blocks: All of them.
        coarse: The coarse model.
        results: Of each block that was trained.
    """

    def __init__(self, blocks: Sequence[BlockRun], coarse: StoredState, results: Mapping[int, StoredState]) -> None:
        self.blocks, self.coarse, self.results = blocks, coarse, results
        self.ids = {index: stored.column(ID) for index, stored in results.items()}

    def shares(self) -> tuple[BlockContribution, ...]:
        """What each block gives: the points that it owns, of those that it has."""
        kept = [0] * len(self.blocks)
        for piece in self.coarse.pieces():
            owner = self.blocks[0].plan.cells.owner(piece.points.params["means"])
            for block in self.blocks:
                kept[block.index] += int((owner == block.index).sum())
        return tuple(
            BlockContribution(at, at not in self.ids, len(self.ids[at]) if at in self.ids else count, count)
            for at, count in enumerate(kept)
        )

    def pieces(self) -> Iterator[Columns]:
        """The parameters, in the order of the coarse model."""
        recipe, begin = self.blocks[0].run.recipe, 0
        for piece in self.coarse.pieces():
            params = finished_piece(recipe.pretrain, piece)
            ids = torch.arange(begin, begin + len(params["means"]))
            begin += len(ids)
            copies = []
            for index, own in self.ids.items():
                low, high = torch.searchsorted(own, torch.tensor([int(ids[0]), begin])).tolist()
                if low < high:
                    there = finished_piece(recipe.tune, self.results[index].rows(low, high))
                    copies.append(PointCopies(own[low:high], there))
            if copies:
                means, counts = mean_copies(copies, ids)
                known = counts > 0
                params = {n: torch.where(known.view(-1, *[1] * (v.dim() - 1)), means[n], v) for n, v in params.items()}
            yield params
