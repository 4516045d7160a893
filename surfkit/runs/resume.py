"""Whether a run may go on in a folder, and what is written down when it does."""

from __future__ import annotations

import itertools
import json
import platform
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load, read_json, write_json
from surfkit.core.events import Warned, emit
from surfkit.core.registry import offered_once, records
from surfkit.core.schedule import rescale_like
from surfkit.core.version import own_version
from surfkit.io.datasets.depth_map_index import is_there, located, read_made
from surfkit.io.datasets.depth_prior import prior_files
from surfkit.io.datasets.fingerprint import Fingerprint, changed, changed_file, fingerprint
from surfkit.io.datasets.read import read
from surfkit.runs import journal
from surfkit.runs.folder import Run, read_data, read_record
from surfkit.runs.recipe import Recipe
from surfkit.runs.run_notes import RunNotes
from surfkit.scene.scene import Frame, Scene
from surfkit.train.data_cache import CacheSettings

PUT_BACK = "put them back"
SAME_PLACE = 1e-6
"""Cameras that have moved by less, in extents of the scene, have not: programs round the last digits."""


def refuse_other_run(run: Run) -> None:
    """BadInput if the folder holds a run that this one does not continue; a warning if this one makes it longer, or
    shorter than it was to be."""
    there = read_recipe_before(run.out / "recipe.json", run.recipe)
    now = dump(run.recipe)
    before_about = there.get("about") if isinstance(there, dict) else None
    other = [name for name in ("mesh", "lod", "compress") if isinstance(there, dict) and there.get(name) != now[name]]
    if isinstance(there, dict):
        there |= {name: now[name] for name in ("mesh", "lod", "compress", "test_every")}  # training is the same
        before = there.get("refine")
        prefix = isinstance(before, list) and first_difference(before, now["refine"][: len(before)]) is None
        if prefix and there.get("pretrain") == now["pretrain"]:
            there |= {"refine": now["refine"]}  # the model that is there can be refined further
    found = None if there is None else first_difference(there, now)
    if found and not (found := difference_but_length(run, there)):
        emit(
            Warned(
                f"the run is made {'longer' if run.recipe.pretrain.steps > there['pretrain']['steps'] else 'shorter'}, "
                f"from {there['pretrain']['steps']} steps to {run.recipe.pretrain.steps}: "
                "steps still to come follow the schedules of the new length, those already made followed the old ones, "
                "so the result is not that of a run of this length from the start"
            )
        )
    if not found and run.record.exists():
        before = dump(read_data(run.out))  # with defaults of newer settings
        found = first_difference(before | {"priors": None}, dump(run.data) | {"priors": None}, "data")
    if found:
        at, old, new = found
        what = f"holds a run with {at} {abbreviate(old)}, and this one has {abbreviate(new)}"
        names = [recipe_name(about) for about in (before_about, run.recipe.about)]
        if not at.startswith("data.") and None not in names and names[0] != names[1]:
            what = f"holds a run of recipe:{names[0]}, and this one is of recipe:{names[1]}"
        raise BadInput(f"--out {run.out} {what}; name another folder, or delete that one")
    for name in other:
        {"mesh": run.mesh_record, "lod": run.lod_record, "compress": run.compressed_record}[name].unlink(
            missing_ok=True
        )


def recipe_name(about: Any) -> str | None:
    """Name of the recipe that is offered with this description, which runs keep; None if there is none."""
    offered = offered_once("surfkit_recipes", "a recipe")
    return next((name for name, recipe in offered.items() if about and recipe.about == about), None)


def read_recipe_before(path: Path, now: Recipe) -> Any:
    """Content of a recipe.json, with the defaults of newer settings if it is still a recipe; None if there is no file.

    Runs of older versions made no depth maps: they continue as they began, however the recipe makes them `now`.
    """
    there = read_json(path, dict[str, Any]) if path.exists() else None
    if there is not None:
        there = {"depth": dump(now.depth)} | there
    try:
        return dump(load(Recipe, there)) if there is not None else None
    except BadInput:
        return there  # the difference will tell


def difference_but_length(run: Run, there: Any) -> tuple[str, Any, Any] | None:
    """The first difference beside the length between a recipe and one in the folder; None if there is none.

    The recipe may be longer, or as short as the steps that are made allow, with all schedules scaled (`--steps`), or
    with none scaled (`--pretrain.steps`).
    """
    plain = first_difference(there, dump(run.recipe))
    now = run.recipe.pretrain.steps
    stage = there.get("pretrain") if isinstance(there, dict) else None
    before = stage.get("steps") if isinstance(stage, dict) else None
    if not isinstance(before, int) or not 0 < before != now or (now < before and steps_made(run) > now):
        return plain
    old = replace(load(Recipe, there, f"{run.out / 'recipe.json'}"), about=run.recipe.about)
    if dump(replace(old, pretrain=replace(old.pretrain, steps=now))) == dump(run.recipe):
        return None
    # Counts of the longer one are the finer ones.
    short, long = (old, run.recipe) if before < now else (run.recipe, old)
    scaled = replace(rescale_like(short, max(now, before) / min(now, before), long), lod=long.lod)  # which may differ
    pair = (scaled, long) if before < now else (long, scaled)
    return first_difference(*map(dump, pair))


def steps_made(run: Run) -> int:
    """Steps of the first stage that the journal has; the last checkpoint has no more."""
    lines = journal.read(run.out / journal.JOURNAL_FILE)
    return max((line.get("index", 0) for line in lines if line["event"] == "StepDone"), default=0)


def first_difference(old: Any, new: Any, at: str = "") -> tuple[str, Any, Any] | None:
    """Path and both values of the first difference between plain data; `about` of a recipe does not count."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            path = f"{at}.{key}" if at else key
            if path != "about" and (found := first_difference(old.get(key), new.get(key), path)):
                return found
        return None
    if isinstance(old, list) and isinstance(new, list):  # where one is longer, its first item too many tells
        pairs = enumerate(itertools.zip_longest(old, new))
        first = next((found for i, (a, b) in pairs if (found := first_difference(a, b, f"{at}.{i}"))), None)
        return first or (None if len(old) == len(new) else (at, old, new))
    return None if old == new else (at, old, new)


def refuse_changed(run: Run, scene: Scene, skipped: set[str]) -> Fingerprint:
    """The fingerprint of the data, or BadInput if it is not that of the data which the run began with.

    Args:
        run: The run.
        scene: Its data.
        skipped: Names of photographs that the run has found damaged; they do not count.
    """
    now, other = compared_data(run, scene, skipped)
    if other is not None:
        raise BadInput(f"--out {run.out}: {other}, name another folder, or delete that one")
    return now


def compared_data(run: Run, scene: Scene, skipped: set[str]) -> tuple[Fingerprint, str | None]:
    """The fingerprint of the data, and in words what is not as it was when the run began; None if nothing is.

    Args:
        run: The run.
        scene: Its data.
        skipped: Names of photographs that the run has found damaged; they do not count.
    """
    before = read_json(run.inputs, Fingerprint) if run.inputs.exists() else None
    own = replace(run.data, priors=None)  # of maps that were made for the run, the name of their folder tells
    now = fingerprint(scene, before, prior_files(own, scene) if run.needs_priors else None, run.files)
    if before is None:
        return now, None
    if (path := changed_file(before, now)) is not None:
        return now, f"{path} has changed since the run began; put the old file back"
    if (what := _difference(run, scene, before, now, skipped)) is not None:
        return now, f"the data in {run.data.path} are not those that the run began with: {what}; {PUT_BACK}"
    return now, None


def read_unchanged(run: Run) -> Scene:
    """The data set of a run, to make something of it and of what the run has come to.

    Files that the recipe names are not looked at: the run has taken from them what it needs. Runs of versions that kept
    no fingerprint are not compared.

    Raises:
        BadInput: The data set is gone, or not what the run was trained on: cameras and photographs of now would be put
            beside results of before.
    """
    scene, what = _read_compared(run)
    if what is not None:
        raise BadInput(f"{what}; {PUT_BACK}, or train on the data of now in another folder")
    return scene


def read_noting_changes(run: Run) -> Scene:
    """The data set of a run, to look at: a note says what is not as it was when the run was trained."""
    scene, what = _read_compared(run)
    if what is not None:
        emit(Warned(f"{what}; what is shown of the data set need not fit the model"))
    return scene


def _read_compared(run: Run) -> tuple[Scene, str | None]:
    """The data set of a run, and a sentence on what has changed in it since the run was trained; None if nothing has.

    Raises:
        BadInput: The data set is gone, or cannot be read.
    """
    if not run.data.path.exists():
        raise BadInput(
            f"{run.out}: its data set {run.data.path} is not there; put it back, or a link there to where it is now"
        )
    scene = read(run.data)
    if not run.inputs.exists():
        return scene, None
    before = read_json(run.inputs, Fingerprint)
    record = read_record(run.out)
    is_own = run.needs_priors and run.data.priors is None  # it was trained on maps of the data set, not on made ones
    now = fingerprint(scene, before, prior_files(run.data, scene) if is_own else None)
    what = _difference(run, scene, before, now, record.get("skipped", ()))
    if what is None:
        return scene, None
    text = f"{run.out}: the data in {run.data.path} have changed since the run was trained: {what}"
    versions = record.get("versions")
    trained_by = versions.get("surfkit") if isinstance(versions, dict) else None
    if trained_by not in (None, own_version()):
        text += f" (or surfkit {own_version()} reads them otherwise than {trained_by}, which trained the run)"
    return scene, text


def _difference(run: Run, scene: Scene, before: Fingerprint, now: Fingerprint, skipped: Collection[str]) -> str | None:
    """The first difference between the data of a run and those of now in words, and how many more there are."""
    found = [change.what for change in changed(before, now) if change.name not in skipped]
    if not found and (moved := _moved(run, scene.frame)) is not None:
        found = [moved]
    if not found:
        return None
    return found[0] + (f" and {len(found) - 1} more" if len(found) > 1 else "")


@dataclass(frozen=True)
class FrameRecord:
    """Where the local frame of a run lies, as run.json has it; see `Frame`."""

    origin: tuple[float, float, float]
    scale: float


def _moved(run: Run, frame: Frame) -> str | None:
    """What has become of the coordinates of a data set: fingerprints are of the local frame, which moves with them."""
    known = read_record(run.out).get("frame")
    if not isinstance(known, dict):  # older runs
        return None
    place = load(FrameRecord, {name: known.get(name) for name in ("origin", "scale")}, f"{run.record}: frame")
    moved = float(np.abs(np.subtract(place.origin, frame.origin)).max()) * frame.scale
    if moved <= SAME_PLACE and abs(place.scale / frame.scale - 1) <= SAME_PLACE:
        return None
    then, here = (" ".join(f"{value:.9g}" for value in origin) for origin in (place.origin, frame.origin))
    sizes = f"{1 / place.scale:.6g}", f"{1 / frame.scale:.6g}"
    grown = f", and the extent of the scene {sizes[0]} and is {sizes[1]}" if sizes[0] != sizes[1] else ""
    return f"the reconstruction has other coordinates: the middle of its cameras was {then} and is {here}{grown}"


def write_run_files(
    run: Run,
    backend: str,
    caches: CacheSettings,
    prints: Fingerprint,
    notes: RunNotes,
    frame: Frame,
    light: dict[str, Any] | None = None,
) -> None:
    """Write run.json, inputs.json and recipe.json; the recipe last, as it makes the folder a run. `light` is what
    run.json says of it, if anything."""
    before = read_record(run.out)
    notes.begin(
        run.record,
        {
            "versions": {"surfkit": own_version(), "python": platform.python_version(), "torch": torch.__version__},
            "plugins": [str(plugin) for plugin in records() if plugin.distribution],
            "device": backend,
            "points_on": caches.points.place,
            "threads": torch.get_num_threads(),
            "seed": run.recipe.seed,
            "data": run.data,
            "folder": str(run.out.resolve()),
            "prepare_cpu_seconds": depth_maps_cpu_seconds(run, before),
            "frame": {
                "origin": frame.origin.tolist(),
                "scale": frame.scale,
                "offset": frame.shift,
                "crs": frame.crs,
                "metres_per_unit": frame.metres,
            },
            **({} if light is None else {"light": light}),
        },
        before,
    )
    write_json(run.inputs, prints)
    write_json(run.out / "recipe.json", run.recipe)


def depth_maps_cpu_seconds(run: Run, before: dict[str, Any]) -> float | None:
    """CPU time of the depth maps made for a run; None where it uses those of the data set, or none."""
    if run.data.priors is None:
        return None
    if not is_there(run.data.priors):
        return before.get("prepare_cpu_seconds")
    return round(read_made(located(run.data.priors)).cpu_seconds, 2)


def abbreviate(value: Any) -> str:
    """A value in a few words."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
