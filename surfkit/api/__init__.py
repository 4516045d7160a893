"""surfkit in Python: read a data set, train, draw, mesh, measure, export. What the commands do, as functions.

Arrays are numpy's or torch's, with the shapes that are stated; positions are in the frame of the input, as in files.
Wrong data and settings raise `surfkit.BadInput`, whose text is one line.
"""

from __future__ import annotations

from pathlib import Path

from surfkit.api.compare_surfaces import compare
from surfkit.api.dataset import Dataset, read
from surfkit.api.listen import OnStep, listening
from surfkit.api.results import Figures, RunMesh
from surfkit.api.run import TrainedRun, open_run
from surfkit.api.scene_of_arrays import from_arrays
from surfkit.api.splats import read_splats, save_splats
from surfkit.api.torch_state import own_torch_state
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.events import say
from surfkit.core.fit import fit
from surfkit.core.registry import offered_once, unknown
from surfkit.raster.select import Device, torch_device
from surfkit.runs import pipeline
from surfkit.runs.blocks.train_blocks import Compute
from surfkit.runs.recipe import Recipe, complete, with_steps
from surfkit.train.data_cache import CacheSettings
from surfkit.train.points_on import Place, PointsOn
from surfkit.train.stage import Stage

__all__ = [
    "Dataset",
    "Figures",
    "OnStep",
    "RunMesh",
    "TrainedRun",
    "compare",
    "from_arrays",
    "get_recipe",
    "open_run",
    "read",
    "read_splats",
    "save_splats",
    "train",
]


def get_recipe(name: str | Path | Recipe) -> Recipe:
    """A recipe by its name ("surface"), of a JSON file, or the one that is given.

    `surfkit.evolve(recipe, "pretrain.densify", None)` gives one with another value.

    Raises:
        BadInput: There is none of this name.
    """
    if isinstance(name, Recipe):
        return name
    text = str(name).removeprefix("recipe:")
    if text.endswith(".json"):
        return read_json(Path(text), Recipe)
    known = offered_once("surfkit_recipes", "a recipe")
    if text not in known:
        raise BadInput(unknown("recipe", text, known))
    return complete(known[text])


def train(
    recipe: str | Path | Recipe,
    scene: Dataset | str | Path,
    out: str | Path,
    *,
    steps: int | None = None,
    device: Device = "auto",
    on_step: OnStep | None = None,
    cache: str = "auto",
    points_on: Place = "auto",
    scratch: str | Path | None = None,
) -> TrainedRun:
    """Train, and make the mesh if the recipe has one; a run that was interrupted goes on where it stopped.

    Args:
        recipe: Its name, its file, or itself.
        scene: The data set.
        out: Run folder.
        steps: Optimisation steps; schedules are scaled along. By default those of the recipe; where these are as always
            and its start knows how many suit the number of photographs, so many, which is said.
        device: For training and drawing: "auto", "cpu", "cuda", "cuda:1", or a rasterizer by its name.
        on_step: Called after each step.
        cache: Memory for photographs, such as "4GB".
        points_on: Where points are kept: "device" (where they are drawn), "host" or "disk", as `surfkit train` has it.
        scratch: Folder for the files of points that are kept on the disk; by default the run folder.

    Raises:
        BadInput: Wrong settings or data, or `out` holds another run.
        Fault: Memory, disk or numbers gave out; the last checkpoint is whole.
    """
    chosen, is_file = get_recipe(recipe), str(recipe).endswith(".json")
    steps, folder, device = fit(int | None, steps, "steps"), fit(Path, out, "out"), str(device)
    cache = fit(str, cache, "cache")
    given = scene if isinstance(scene, Dataset) else read(scene, test_every=chosen.test_every)
    if steps is None and not is_file and chosen.has_stages and chosen.pretrain.steps == Stage().steps:
        count = len(given.train)
        steps = chosen.start.usual_steps(count, torch_device(device).type == "cuda")
        if steps is not None:
            say(f"steps: {steps:,}, as there are {count:,} photographs to train on; steps= changes it")
    chosen = chosen if steps is None else with_steps(chosen, steps)
    with listening(on_step), own_torch_state():
        points = PointsOn(points_on, None if scratch is None else Path(scratch))
        pipeline.run(chosen, given.data, folder, Compute(device), caches=CacheSettings(cache, points=points))
    return open_run(folder, device=device)
