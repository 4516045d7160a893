"""One block of a run: what is planned for it, its folder, and its state."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.losses.consensus import Consensus
from surfkit.partition.plan import BlockPlan as PlannedBlock
from surfkit.partition.plan import PartitionPlan
from surfkit.runs.execute.block_state import BlockState, read_state, write_state
from surfkit.runs.folder import Run, RunStage
from surfkit.runs.recipe import Recipe


@dataclass(frozen=True)
class BlocksRecord:
    """Content of `blocks/plan.json`.

    Attributes:
        coarse_steps: Steps of the coarse model that the plan was made for.
        plan: Cells and blocks.
    """

    coarse_steps: int
    plan: PartitionPlan


@dataclass(eq=False)
class BlockRun:
    """One block of a run, for the process that trains it or waits for it.

    `state` is read once and changed with `write`. Whoever waits for another process to change it calls `read`.

    Attributes:
        run: The run.
        plan: All its blocks.
        index: Number of this one.
        state: As this process has last read or written it.
    """

    run: Run
    plan: PartitionPlan
    index: int
    state: BlockState = field(init=False)
    _writing: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    def __post_init__(self) -> None:
        self.read()

    @property
    def planned(self) -> PlannedBlock:
        """What the plan says of it."""
        return self.plan.blocks[self.index]

    @property
    def folder(self) -> Path:
        """Its own folder."""
        return self.run.blocks / f"{self.index:03}"

    @property
    def views_file(self) -> Path:
        """Its views, so that it can be trained without reading the data set."""
        return self.folder / "views.npz"

    @property
    def stage(self) -> RunStage:
        """The stage that trains it, with the settings of the recipe."""
        return replace(self.run.merged, out=self.folder, block=self.index)

    @property
    def is_done(self) -> bool:
        """Whether it has all the steps that it can take now, or has no views to be trained on."""
        goal, state = self.goal, self.state
        if goal < self.run.recipe.tune.steps:  # it waits for the others
            return not self.planned.views or (state.status == "planned" and state.step == goal)
        return not self.planned.views or (state.status == "done" and state.step >= goal)

    @property
    def goal(self) -> int:
        """The step up to which it can be trained now: the last, or the end of the round that all blocks are in."""
        rule, steps = consensus_of(self.run.recipe), self.run.recipe.tune.steps
        return steps if rule is None else min(steps, (rounds_agreed(self.run) + 1) * rule.every)

    @property
    def is_out_of_memory(self) -> bool:
        """Whether it ran out of memory when it was last trained."""
        return self.state.kind == "oom"

    def read(self) -> BlockState:
        """Read its state again.

        Raises:
            BadInput: The file is damaged.
        """
        self.state = read_state(self.folder)
        return self.state

    def write(self, **changes: object) -> None:
        """Change some fields of its state, in the file too. One process at a time may, with several threads."""
        with self._writing:
            self.state = write_state(self.folder, self.state, **changes)


def read_plan(run: Run) -> BlocksRecord:
    """The plan of a run.

    Raises:
        BadInput: There is none yet, or it is damaged.
    """
    path = plan_file(run)
    if not path.exists():
        raise BadInput(f"{path} is not there: the run has no blocks, or its coarse model is not finished")
    return read_json(path, BlocksRecord)


def plan_file(run: Run) -> Path:
    """Where the plan of a run is saved."""
    return run.blocks / "plan.json"


def consensus_of(recipe: Recipe) -> Consensus | None:
    """How the blocks of a recipe agree on common points; None if each is trained by itself."""
    return next((term for term in recipe.tune.regularizers.values() if isinstance(term, Consensus)), None)


def agreement_file(run: Run, number: int) -> Path:
    """Where it is saved what blocks have agreed on at the end of a round, counted from 1."""
    return run.blocks / "consensus" / f"{number:06}.safetensors"


def rounds_agreed(run: Run) -> int:
    """Rounds at whose end the blocks have agreed."""
    return max((int(path.stem) for path in agreement_file(run, 0).parent.glob("[0-9]*.safetensors")), default=0)


def load_blocks(run: Run, plan: PartitionPlan) -> list[BlockRun]:
    """All blocks of a plan, with their states as they are now."""
    return [BlockRun(run, plan, index) for index in range(len(plan.blocks))]


def unfinished(blocks: Sequence[BlockRun]) -> list[BlockRun]:
    """The blocks that still have steps to do."""
    return [block for block in blocks if not block.is_done]


def started_folders(run: Run) -> list[Path]:
    """Folders of the blocks that have been started, also by an earlier plan."""
    return sorted(run.blocks.glob("[0-9]*"))
