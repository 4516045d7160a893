"""What a user should know before hours are spent on a run."""

from __future__ import annotations

from surfkit.core.events import Warned, emit
from surfkit.core.registry import name_of
from surfkit.run.folder import Run
from surfkit.scene.scene import Scene
from surfkit.train.state import StageState


def warn_of_no_edits(run: Run, scene: Scene) -> None:
    """Say which stages cannot add a point, or never remove one by its worth, though they are to."""
    for at in run.stages:
        stage, views = at.stage, 1 if at.name == "tune" else len(scene.train)  # a block may have few of them
        edits = stage.densify.edits(stage.steps) if stage.densify is not None else None
        if edits is not None and len(edits) == 0:
            emit(
                Warned(
                    f"{at.setting}: no point will be added, as no edit of densify falls within {stage.steps:,} "
                    f"steps; more steps, or a lower {at.setting}.densify.start and every, change that"
                )
            )
        for number, prune in enumerate(stage.prune):
            if (edits := prune.edits(stage.steps, views)) is not None and len(edits) == 0:
                epochs = f" of {views:,} photographs to an epoch" * (views > 1)
                due = f"is never due within its {stage.steps:,} steps{epochs}; more steps, or another schedule of it,"
                emit(Warned(f"{at.setting}.prune.{number}: {name_of(prune)} {due} change that"))


def warn_of_gaps(scene: Scene, state: StageState | None) -> None:
    """Say what the data does not allow."""
    if state is None and not scene.held_out:
        emit(Warned("no photograph is kept from training, so the quality cannot be measured; see --test-every"))
