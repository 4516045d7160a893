"""A run folder: what lies where, what it was made from, and whether this run may go on in it."""

from __future__ import annotations

import itertools
import json
import platform
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load, read_json, write_json
from surfkit.core.events import FileWritten, PhotoSkipped, Warned, emit
from surfkit.core.registry import records
from surfkit.core.schedule import rescale_like
from surfkit.core.version import own_version
from surfkit.primitives.base import Primitive
from surfkit.readers.data import Data
from surfkit.readers.depth_prior import prior_files
from surfkit.readers.fingerprint import Fingerprint, changed, fingerprint
from surfkit.readers.made_maps import is_there, located, read_made
from surfkit.recipe import Recipe
from surfkit.refine.base import Refine
from surfkit.run import journal
from surfkit.run.notes import Notes
from surfkit.scene.scene import Frame, Scene
from surfkit.train import checkpoint
from surfkit.train.stage import Stage

FILES = ("recipe.json", "run.json", "inputs.json", "events.jsonl", "metrics.json", "point_cloud.ply")
"""In a run folder."""
FOLDERS = ("pretrain", "tune", "blocks", "pictures", "progress", "method", "result")


@dataclass(frozen=True)
class Run:
    """A run folder and what it was made from.

    Attributes:
        out: The folder.
        recipe: Part of it as recipe.json.
        data: Part of it in run.json.
        part: The stage that is spoken of: "pretrain" for the whole scene at once, "tune" for a block, and for all of
            them when they are merged; then "refine0", "refine1" and so on.
        block: Number of the block, if it is one's.
    """

    out: Path
    recipe: Recipe
    data: Data
    part: str = "pretrain"
    block: int | None = None

    @property
    def title(self) -> str:
        """What is being done, for people."""
        return self.part if self.block is None else f"block {self.block}"

    @property
    def parts(self) -> tuple[str, ...]:
        """All there are, in their order."""
        tune = ("tune",) if self.recipe.partition is not None else ()
        return ("pretrain", *tune, *(f"refine{at}" for at in range(len(self.recipe.refine))))

    @property
    def refined(self) -> tuple[Refine, ...]:
        """What the model has gone through as a whole at the end of the stage that is spoken of."""
        return self.recipe.refine[: int(self.part[6:]) + 1] if self.part.startswith("refine") else ()

    @property
    def stage(self) -> Stage:
        """The one that is spoken of."""
        return self.refined[-1].stage if self.refined else getattr(self.recipe, self.part)

    @property
    def shown(self) -> Stage:
        """The last one so far that was shown photographs: colours are as it has learnt them."""
        so_far = [replace(self, part=part) for part in self.parts[: self.parts.index(self.part) + 1]]
        return [run.stage for run in so_far if not (run.refined and run.refined[-1].taught)][-1]

    @property
    def setting(self) -> str:
        """Where that stage stands in the recipe, as the command line has it."""
        return f"refine.{len(self.refined) - 1}.stage" if self.refined else self.part

    @property
    def primitive(self) -> Primitive:
        """What the points are in the stage that is spoken of."""
        found = self.recipe.primitive
        for refine in self.refined:
            found = refine.primitive(found)
        return found

    @property
    def needs_priors(self) -> bool:
        """Whether training looks at depth priors: the method, a loss of the recipe, or its start."""
        if self.recipe.method.needs_prior:
            return True
        stages = [replace(self, part=part).stage for part in self.parts]
        return self.recipe.start.needs_prior or any(
            loss.needs_prior for stage in stages for loss in stage.losses.values()
        )

    @property
    def wants_priors(self) -> bool:
        """Whether anything looks at depth priors: training, or the mesher."""
        return self.needs_priors or (self.recipe.mesh is not None and self.recipe.mesh.needs_prior)

    @property
    def checkpoint(self) -> Path:
        """The state of the optimisation."""
        return self.out / self.part / "checkpoint.safetensors"

    @property
    def metrics(self) -> Path:
        """The measurements."""
        return self.out / "metrics.json"

    @property
    def cloud(self) -> Path:
        """The points, in the frame of the input."""
        return self.out / "point_cloud.ply"

    @property
    def cameras(self) -> Path:
        """The cameras, in the coordinates of the points."""
        return self.out / "cameras.json"

    @property
    def mesh_record(self) -> Path:
        """How the mesh was made and what it is; written when its files are."""
        return self.out / "mesh.json"

    @property
    def mesh_pictures(self) -> Path:
        """Pictures of the mesh."""
        return self.out / "mesh_pictures"

    @property
    def mesh(self) -> Path:
        """The surface, in the frame of the input."""
        return self.out / "mesh.ply"

    @property
    def pictures(self) -> Path:
        """Renders beside the photographs."""
        return self.out / "pictures"

    @property
    def record(self) -> Path:
        """What the run was made from and what happened."""
        return self.out / "run.json"

    @property
    def inputs(self) -> Path:
        """The fingerprint of the data."""
        return self.out / "inputs.json"


def refuse_file(out: Path) -> None:
    """BadInput if a file is in the place of a run folder, or a folder in the place of one of its files."""
    if out.exists() and not out.is_dir():
        raise BadInput(f"--out {out}: a file, not a folder; name another one")
    for name in FILES:
        if (out / name).is_dir():
            raise BadInput(f"{out / name}: a folder, where the run keeps a file; delete it")
    for path in [*(out / name for name in FOLDERS), *out.glob("refine[0-9]")]:
        if path.is_file():
            raise BadInput(f"{path}: a file, where the run keeps a folder; delete it")


def refuse_no_run(out: Path) -> None:
    """BadInput if a folder holds no run."""
    if not (out / "recipe.json").exists() or not (out / "run.json").exists():
        raise BadInput(f"{out}: no run folder (no recipe.json and run.json in it); name one that surfkit train made")


def read_record(out: Path) -> dict[str, Any]:
    """What run.json of a run folder says; empty where there is none.

    Raises:
        BadInput: It is damaged.
    """
    path = out / "run.json"
    record = read_json(path, dict[str, Any]) if path.exists() else {}
    for name in ("notes", "skipped"):
        _require_texts(path, name, record.get(name, []))
    if (memory := record.get("memory_bytes")) is not None:
        load(dict[str, int], memory, f"{path}: memory_bytes")
    return record


def read_data(out: Path) -> Data:
    """The data that a run was made from."""
    data = read_record(out).get("data")
    if isinstance(data, dict) and isinstance(name := data.get("split"), str):
        data |= {"split": {"use": name}}  # of an older run: a split was a name
    try:
        return load(Data, data, "data")
    except BadInput as error:
        raise BadInput(f"{out / 'run.json'}: {error}") from error


def _require_texts(path: Path, name: str, value: Any) -> None:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise BadInput(f"{path}: {name} is not a list of texts; {path.parent} is damaged, begin in another folder")


def refuse_other(run: Run) -> None:
    """BadInput if the folder holds a run that this one does not continue; a note if this one makes it longer."""
    there = recipe_before(run.out / "recipe.json", run.recipe)
    now = dump(run.recipe)
    remesh = isinstance(there, dict) and there.get("mesh") != now["mesh"]
    if isinstance(there, dict):
        there |= {"mesh": now["mesh"]}  # training is the same
        before = there.get("refine")
        prefix = isinstance(before, list) and difference(before, now["refine"][: len(before)]) is None
        if prefix and there.get("pretrain") == now["pretrain"]:
            there |= {"refine": now["refine"]}  # the model that is there can be refined further
    found = None if there is None else difference(there, now)
    if found and not (found := longer(run, there)):
        emit(
            Warned(
                f"the run is made longer, from {there['pretrain']['steps']} steps to {run.recipe.pretrain.steps}: "
                "steps still to come follow the schedules of the new length, those already made followed the old ones, "
                "so the result is not that of a run of this length from the start"
            )
        )
    if not found and run.record.exists():
        before = dump(read_data(run.out))  # with defaults of newer settings
        found = difference(before | {"priors": None}, dump(run.data) | {"priors": None}, "data")
    if found:
        at, old, new = found
        raise BadInput(
            f"--out {run.out} holds a run with {at} {short(old)}, and this one has {short(new)}; "
            "name another folder, or delete that one"
        )
    if remesh:
        run.mesh_record.unlink(missing_ok=True)


def recipe_before(path: Path, now: Recipe) -> Any:
    """What a recipe.json says, with defaults of newer settings if it is still a recipe; None where there is none.

    Runs of before made no depth maps: they go on as they began, however the recipe makes them `now`.
    """
    there = read_json(path, dict[str, Any]) if path.exists() else None
    if there is not None:
        there = {"depth": dump(now.depth)} | there
    try:
        return dump(load(Recipe, there)) if there is not None else None
    except BadInput:
        return there  # the difference will tell


def longer(run: Run, there: Any) -> tuple[str, Any, Any] | None:
    """What else than its length distinguishes a longer recipe from the one in the folder; None if nothing does.

    Longer with all schedules scaled along (`--steps`), or with none (`--pretrain.steps`).
    """
    plain = difference(there, dump(run.recipe))
    now = run.recipe.pretrain.steps
    stage = there.get("pretrain") if isinstance(there, dict) else None
    before = stage.get("steps") if isinstance(stage, dict) else None
    if not isinstance(before, int) or not 0 < before < now:
        return plain
    old = replace(load(Recipe, there, f"{run.out / 'recipe.json'}"), about=run.recipe.about)
    if dump(replace(old, pretrain=replace(old.pretrain, steps=now))) == dump(run.recipe):
        return None
    return difference(dump(rescale_like(old, now / before, run.recipe)), dump(run.recipe))


def difference(old: Any, new: Any, at: str = "") -> tuple[str, Any, Any] | None:
    """Path and both values of the first difference between plain data; what a recipe says of itself does not count."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            path = f"{at}.{key}" if at else key
            if path != "about" and (found := difference(old.get(key), new.get(key), path)):
                return found
        return None
    if isinstance(old, list) and isinstance(new, list):  # where one is longer, its first item too many tells
        pairs = enumerate(itertools.zip_longest(old, new))
        first = next((found for i, (a, b) in pairs if (found := difference(a, b, f"{at}.{i}"))), None)
        return first or (None if len(old) == len(new) else (at, old, new))
    return None if old == new else (at, old, new)


def refuse_changed(run: Run, scene: Scene, skipped: set[str]) -> Fingerprint:
    """The fingerprint of the data, or BadInput if it is not that of the data which the run began with.

    Args:
        run: The run.
        scene: Its data.
        skipped: Names of photographs that the run has found damaged; they do not count.
    """
    before = read_json(run.inputs, Fingerprint) if run.inputs.exists() else None
    own = replace(run.data, priors=None)  # of maps that were made for the run, the name of their folder tells
    now = fingerprint(scene, before, prior_files(own, scene) if run.needs_priors else None)
    if before is not None and (found := [text for text in changed(before, now) if text.name not in skipped]):
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        raise BadInput(
            f"--out {run.out}: the data in {run.data.path} are not those that the run began with: {found[0].what}"
            f"{more}; put them back, name another folder, or delete that one"
        )
    return now


def claim(run: Run, backend: str, prints: Fingerprint, notes: Notes, frame: Frame) -> None:
    """Write down what the run is made from, and on what it runs; the recipe last, as it makes the folder a run."""
    before = read_record(run.out)
    notes.begin(
        run.record,
        {
            "versions": {"surfkit": own_version(), "python": platform.python_version(), "torch": torch.__version__},
            "plugins": [str(plugin) for plugin in records() if plugin.distribution],
            "device": backend,
            "threads": torch.get_num_threads(),
            "seed": run.recipe.seed,
            "data": run.data,
            "prepare_cpu_seconds": prepare_cpu_seconds(run, before),
            "frame": {
                "origin": frame.origin.tolist(),
                "scale": frame.scale,
                "offset": frame.shift,
                "crs": frame.crs,
                "metres_per_unit": frame.metres,
            },
        },
        before,
    )
    write_json(run.inputs, prints)
    write_json(run.out / "recipe.json", run.recipe)


def prepare_cpu_seconds(run: Run, before: dict[str, Any]) -> float | None:
    """What the depth maps have cost that were made for a run; None where it uses those of the data set, or none."""
    if run.data.priors is None:
        return None
    if not is_there(run.data.priors):
        return before.get("prepare_cpu_seconds")
    return round(read_made(located(run.data.priors)).cpu_seconds, 2)


def relay(out: Path, folder: Path, prefix: str) -> None:
    """Note for the run in `out` what the journal of a part of it, written by another process, has been warned of."""
    record = read_record(out)
    notes, skipped = set(record.get("notes", [])), set(record.get("skipped", []))
    for line in journal.read(folder / journal.NAME):
        text, name = line.get("text"), line.get("name")
        if line["event"] == "Warned" and isinstance(text, str) and not {text, prefix + text} & notes:
            notes.add(text)
            emit(Warned(prefix + text))
        elif line["event"] == "PhotoSkipped" and isinstance(name, str) and name not in skipped:
            skipped.add(name)
            emit(PhotoSkipped(name, str(line.get("reason"))))


def note_metrics(path: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Put measurements into metrics.json beside those of other kinds that are there already, and return them all."""
    metrics = (read_json(path, dict[str, Any]) if path.exists() else {}) | found
    write_json(path, metrics)
    emit(FileWritten(path, "metrics"))
    return metrics


def discard_results(run: Run) -> None:
    """Delete what further steps of a stage make wrong: results, and the states of the stages after it."""
    for path in (run.metrics, run.cloud, run.mesh_record):
        path.unlink(missing_ok=True)
    for part in run.parts[run.parts.index(run.part) + 1 :]:
        later = replace(run, part=part).checkpoint
        checkpoint.discard(later)
        (later.parent / journal.NAME).unlink(missing_ok=True)


def short(value: Any) -> str:
    """A value in a few words."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
