"""What a user should know before hours are spent on a run."""

from __future__ import annotations

import numpy as np

from surfkit.core.events import Warned, emit
from surfkit.core.registry import Component, name_of
from surfkit.runs.folder import Run
from surfkit.runs.recipe import Recipe
from surfkit.scene.scene import Scene
from surfkit.train.smaller import MIN_SIDE_PX
from surfkit.train.stage import Stage
from surfkit.train.state import StageState

NONE_HELD_OUT = (
    "no photograph is held out (kept from training), so PSNR, SSIM and LPIPS cannot be measured; a run trained with "
    "--test-every 8 keeps every 8th to measure with"
)


def warn_before(run: Run, scene: Scene, state: StageState | None) -> None:
    """Say what will not happen as one may expect, before a run begins or goes on from a state."""
    warn_of_gaps(scene, state)
    warn_of_no_edits(run, scene)
    if text := plain_blocks(run.recipe):
        emit(Warned(text))
    warn_of_sizes(run, scene)


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


def plain_blocks(recipe: Recipe) -> str | None:
    """What the tuning of blocks lacks of pretraining, where nobody has said how they are tuned; None for nothing."""
    if recipe.partition is None or (tune := _parts(recipe.tune)) != _parts(Stage()):
        return None
    other = [f"tune.{path}:{name}" for path, name in _parts(recipe.pretrain).items() if tune.get(path) != name]
    if not other:
        return None
    told = "blocks are tuned as 3DGS is, without some parts of pretrain; to keep these, add"
    return f"{told} {' '.join(other)}, and their settings"


def _parts(stage: Stage) -> dict[str, str]:
    """Names of what decides how a stage learns, by their paths in it."""
    parts: dict[str, Component | None] = {f"losses.{key}": loss for key, loss in stage.losses.items()}
    parts |= {f"regularizers.{key}": one for key, one in stage.regularizers.items()}
    parts |= {"appearance": stage.appearance, "optimizer": stage.optimizer, "densify": stage.densify}
    return {path: "none" if part is None else name_of(part) for path, part in parts.items()}


def warn_of_sizes(run: Run, scene: Scene) -> None:
    """Say where a schedule of small photographs does nothing."""
    for at in run.stages:
        quarter, half = at.stage.quarter_until, at.stage.half_until
        largest = max((min(view.camera.width, view.camera.height) for view in scene.train), default=0)
        if 0 < half <= quarter:
            text = f"half_until {half} does nothing, as photographs have a quarter of their size up to step {quarter}"
            emit(Warned(f"{at.setting}.{text}"))
        if (quarter or half) and largest < 2 * MIN_SIDE_PX:
            emit(
                Warned(
                    f"{at.setting}: photographs keep their size in all steps, as {largest} px are too few to halve "
                    f"(the shorter side stays at {MIN_SIDE_PX} px or more)"
                )
            )


def warn_of_gaps(scene: Scene, state: StageState | None) -> None:
    """Say what the data does not allow, once, when a run begins."""
    if state is not None:
        return
    if not scene.held_out:
        emit(Warned(NONE_HELD_OUT))
    if any(shift := scene.frame.shift):
        far, text = np.abs(scene.frame.origin).max(), " ".join(f"{value:.15g}" for value in shift)
        emit(
            Warned(
                f"coordinates reach {far:.0f}, too large for the 32 bits that most programs read: all files of the run "
                f"leave out the offset {text}, which their headers, run.json and mesh.json name"
            )
        )


def note_held_out(run: Run, scene: Scene) -> None:
    """Say how many photographs what is made of a run is without, and how to use all."""
    if not scene.held_out:
        return
    count, data = len(scene.held_out), run.data
    given = {"--split": data.split, "--test-list": data.test_list, "--test-data": data.test_data}
    rule = next((option for option, value in given.items() if value is not None), None)
    names = sorted(view.name for view in (*scene.train, *scene.held_out))
    if rule is not None:
        how = f"{rule} names them"
    elif {view.name for view in scene.held_out} == set(names[:: data.test_every or len(names)]):
        how = "a run trained with --test-every 0 uses all"
    else:
        how = "the data set itself names them for tests"
    text = f"{count} of {len(names)} photographs were held out: not trained on, but kept to measure with"
    emit(Warned(f"{text}; places that only they show are missing or poor; {how}"))
