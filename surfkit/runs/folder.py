"""A run folder: what lies where, its stages, and what it was made from."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surfkit.core.check import BadInput, few
from surfkit.core.codec import load, read_json, write_json
from surfkit.core.events import FileWritten, emit
from surfkit.core.files import where_now
from surfkit.io.datasets.data import Data
from surfkit.primitives.base import Primitive
from surfkit.runs import journal
from surfkit.runs.execute.base import LOG
from surfkit.runs.recipe import Recipe
from surfkit.train import checkpoint
from surfkit.train.refine.base import Refine
from surfkit.train.stage import Stage

SHARED = "shared.json"
"""What a run shares with others, see `surfkit.runs.run_cache`."""
RUN_FILES = (
    "recipe.json",
    "run.json",
    "inputs.json",
    "events.jsonl",
    "light.json",
    "metrics.json",
    "point_cloud.ply",
    SHARED,
)
"""In a run folder."""
RUN_FOLDERS = (
    "pretrain",
    "partition",
    "tune",
    "blocks",
    "pictures",
    "progress",
    "method",
    "result",
    "lod",
    "compressed",
)
MESH_FILES = ("mesh.ply", "mesh.obj", "mesh.glb")
"""Files of meshes in a run folder; others begin with `mesh-lod`."""


@dataclass(frozen=True)
class RunStage:
    """One stage of a run, or of one of its blocks: where it lies, and what is done in it.

    Attributes:
        name: Of its folder, and in events: "pretrain" for the whole scene at once; "tune" for a block, and for all
            blocks when they are merged; then "refine0", "refine1" and so on.
        setting: Its path in the recipe, as on the command line.
        out: Folder of the run, or of the block.
        stage: Its settings.
        primitive: What the points are in it.
        refine: What it does to the model of the stage before; None if it is no refinement.
        block: Number of the block, if it is one's.
    """

    name: str
    setting: str
    out: Path
    stage: Stage
    primitive: Primitive
    refine: Refine | None = None
    block: int | None = None

    @property
    def title(self) -> str:
        """What is being done, for people."""
        return self.name if self.block is None else f"block {self.block}"

    @property
    def folder(self) -> Path:
        """What belongs to the stage alone."""
        return self.out / self.name

    @property
    def journal(self) -> Path:
        """Folder of its journal: refinements count their steps anew, and have their own."""
        return self.out if self.refine is None else self.folder

    @property
    def checkpoint(self) -> Path:
        """The state of the optimisation."""
        return self.folder / "checkpoint.safetensors"

    @property
    def before(self) -> Path:
        """What was measured of the model before, if the stage refines it."""
        return self.folder / "before.json"


@dataclass(frozen=True)
class Run:
    """A run folder and what it was made from.

    Attributes:
        out: The folder.
        recipe: Part of it as recipe.json.
        data: Part of it in run.json.
    """

    out: Path
    recipe: Recipe
    data: Data

    def to_paste(self, command: str) -> str:
        """A command about the run, as a shell takes it: `surfkit mesh 'my run'`."""
        return shlex.join(["surfkit", command, str(self.out)])

    @property
    def stages(self) -> tuple[RunStage, ...]:
        """All stages, in their order."""
        recipe, primitive = self.recipe, self.recipe.primitive
        found = [RunStage("pretrain", "pretrain", self.out, recipe.pretrain, primitive)]
        if recipe.partition is not None:
            found.append(RunStage("tune", "tune", self.out, recipe.tune, primitive))
        for at, refine in enumerate(recipe.refine):
            primitive = refine.primitive(primitive)
            found.append(RunStage(f"refine{at}", f"refine.{at}.stage", self.out, refine.stage, primitive, refine))
        return tuple(found)

    @property
    def pretrain(self) -> RunStage:
        """The stage of the whole scene at once."""
        return self.stages[0]

    @property
    def partition(self) -> Run | None:
        """The pretraining whose model decides the partition, as a run in a folder of this one; None if it is that of
        this run."""
        stage = self.recipe.partition_pretrain
        if stage is None or self.recipe.partition is None:
            return None
        return replace(self, out=self.out / "partition", recipe=replace(self.recipe, pretrain=stage))

    def optimised_stages(self) -> Iterator[RunStage]:
        """The stages that are optimised, also that of the model that decides the partition; none for other methods."""
        if self.recipe.has_stages:
            yield from self.stages
            if self.partition is not None:
                yield replace(self.partition.pretrain, setting="partition_pretrain")

    @property
    def merged(self) -> RunStage:
        """The stage of all blocks together, for a recipe with a partition."""
        return self.stages[1]

    @property
    def last(self) -> RunStage:
        """The stage whose result is that of the run."""
        return self.stages[-1]

    @property
    def blocks(self) -> Path:
        """Folder of the blocks."""
        return self.out / "blocks"

    @property
    def needs_priors(self) -> bool:
        """Whether training looks at depth priors: the method, a loss of the recipe, or its start. Refinements that make
        their own do not count."""
        own = {f"refine.{at}.stage" for at, refine in enumerate(self.recipe.refine) if refine.estimator is not None}
        losses = [loss for path, stage, _ in self.recipe.stages() if path not in own for loss in stage.losses.values()]
        needed = self.recipe.method.needs_prior or self.recipe.start.needs_prior
        return needed or any(loss.needs_prior for loss in losses)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that training reads beside the data set."""
        return (*self.recipe.method.files(), *(self.recipe.start.files() if self.recipe.has_stages else ()))

    @property
    def wants_priors(self) -> bool:
        """Whether anything looks at depth priors: training, or a mesher."""
        return self.needs_priors or any(mesher.needs_prior for mesher in self.recipe.meshers)

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
    def compressed(self) -> Path:
        """Folder of the compressed model, and of what is measured and made of it."""
        return self.out / "compressed"

    @property
    def compressed_model(self) -> Path:
        """The compressed model."""
        return self.compressed / "model.surfkit"

    @property
    def compressed_record(self) -> Path:
        """How the model was compressed; written when its file is."""
        return self.compressed / "compressed.json"

    @property
    def lod(self) -> Path:
        """Folder of the levels of detail."""
        return self.out / "lod"

    @property
    def lod_record(self) -> Path:
        """How the levels of detail were made and what they are; written when their files are."""
        return self.lod / "lod.json"

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

    @property
    def light(self) -> Path:
        """How cameras changed the light of the photographs, where an appearance needs it."""
        return self.out / "light.json"


def refuse_file(out: Path) -> None:
    """BadInput if a file is in the place of a run folder, or a folder in the place of one of its files."""
    if out.exists() and not out.is_dir():
        raise BadInput(f"--out {out}: a file, not a folder; name another one")
    for name in RUN_FILES:
        if (out / name).is_dir():
            raise BadInput(f"{out / name}: a folder, where the run keeps a file; delete it")
    for path in [*(out / name for name in RUN_FOLDERS), *out.glob("refine[0-9]")]:
        if path.is_file():
            raise BadInput(f"{path}: a file, where the run keeps a folder; delete it")
    refuse_links(out)


def refuse_foreign(out: Path) -> None:
    """BadInput if a folder that holds no run has files of the names that a run would give to its own."""
    if (out / "run.json").exists():  # the first that a run writes
        return
    names = (*RUN_FILES, "cameras.json", "mesh.json", *MESH_FILES)
    if foreign := [name for name in names if (out / name).exists()]:
        raise BadInput(
            f"--out {out}: no run folder (no run.json in it), but it has {few(foreign)}, which would be replaced; name "
            "another folder"
        )


def refuse_links(out: Path) -> None:
    """BadInput if a run would write or delete outside of its folder, as something in it is a link to elsewhere.

    Of files, only those count that are written to in place; for others, a new file takes the place of a link.
    """
    for path in _links(out):
        in_place = path.is_dir() or path.name in (journal.JOURNAL_FILE, LOG) or path.is_relative_to(out / "method")
        if in_place and not path.resolve().is_relative_to(out.resolve()):
            raise BadInput(
                f"{path}: a link out of the run folder, to {path.resolve()}, where nothing is written or deleted; "
                "put a folder or file in its place, or keep the whole run folder elsewhere"
            )


def _links(folder: Path) -> Iterator[Path]:
    """All links in a folder and in those inside; none is followed."""
    with suppress(FileNotFoundError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink():
                yield Path(entry.path)
            elif entry.is_dir():
                yield from _links(Path(entry.path))


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
    for name in ("memory_bytes", "gpu_memory_bytes"):
        if (memory := record.get(name)) is not None:
            load(dict[str, int], memory, f"{path}: {name}")
    return record


def read_data(out: Path) -> Data:
    """The data that a run was made from, also where they have moved together with its folder."""
    record = read_record(out)
    data, folder = record.get("data"), record.get("folder")
    if isinstance(data, dict) and isinstance(name := data.get("split"), str):
        data |= {"split": {"use": name}}  # of an older run: a split was a name
    try:
        found = load(Data, data, "data")
    except BadInput as error:
        raise BadInput(f"{out / 'run.json'}: {error}") from error
    there = where_now(found.path, Path(folder), out.resolve()) if isinstance(folder, str) else None
    return found if there is None else found.moved(there)


def _require_texts(path: Path, name: str, value: Any) -> None:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise BadInput(f"{path}: {name} is not a list of texts; {path.parent} is damaged, begin in another folder")


def note_metrics(path: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Put measurements into metrics.json beside those of other kinds that are there already, and return them all."""
    metrics = (read_json(path, dict[str, Any]) if path.exists() else {}) | found
    write_json(path, metrics)
    emit(FileWritten(path, "metrics"))
    return metrics


def discard_results(run: Run, stage: RunStage) -> None:
    """Delete what further steps of a stage make wrong: results, and the states of the stages after it."""
    for path in (run.metrics, run.cloud, run.mesh_record, run.lod_record, run.compressed_record):
        path.unlink(missing_ok=True)
    names = [one.name for one in run.stages]
    for later in run.stages[names.index(stage.name) + 1 :]:
        checkpoint.discard(later.checkpoint)
        (later.folder / journal.JOURNAL_FILE).unlink(missing_ok=True)
