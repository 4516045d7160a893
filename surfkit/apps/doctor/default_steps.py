"""How long a run is if nobody says: as long as it gains, where its start knows, else as its recipe says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surfkit.apps.doctor.gather import gather
from surfkit.cli.recipes import ARGV, chosen_name
from surfkit.core.codec import read_json
from surfkit.core.events import say
from surfkit.io.datasets.data import Data
from surfkit.raster.select import Device, torch_device
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.train.stage import Stage


def with_usual_steps(recipe: Recipe, data: Data, device: Device, out: Path | None = None) -> Recipe:
    """The recipe at the length that suits the number of photographs, told in a line; as it is where that is not known.

    A length that the user gives (`--pretrain.steps`), that of a recipe in a file, and that of a longer run which is in
    the run folder already, stay.

    Args:
        recipe: That the words of the command line choose.
        data: Its data set.
        device: Where it will be trained.
        out: The run folder, where there is one.
    """
    if not _may_choose(recipe):
        return recipe
    count = len(gather(data).train)
    steps = recipe.start.usual_steps(count, torch_device(device).type == "cuda") if count else None
    if steps is None:
        return recipe
    before = _steps_of(out / "recipe.json") if out is not None else 0
    if before > steps:
        return with_steps(recipe, before)
    say(f"steps: {steps:,}, as there are {count:,} photographs to train on; more bring little, --steps changes it")
    return with_steps(recipe, steps)


def _may_choose(recipe: Recipe) -> bool:
    words = ARGV.get()
    is_given = any(word.startswith("--") and word.partition("=")[0].endswith(".steps") for word in words)
    is_file = (chosen_name(words) or "").endswith(".json")
    return recipe.has_stages and recipe.pretrain.steps == Stage().steps and not (is_given or is_file)


def _steps_of(path: Path) -> int:
    """Steps of the run whose recipe is in a file; 0 if there is none. What is wrong with it is told when it is read."""
    try:
        steps = read_json(path, dict[str, Any])["pretrain"]["steps"]
    except (OSError, ValueError, KeyError, TypeError):
        return 0
    return steps if isinstance(steps, int) else 0
