"""What runs share: each part of what a run makes is kept under all that determines it, and taken by the next run."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, load, read_json, write_json
from surfkit.core.events import MemoryTaken, emit, say
from surfkit.core.registry import BUILTIN, plugins, records
from surfkit.depth.base import DepthEstimator
from surfkit.depth.prepare_depth_maps import files_of
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.fingerprint import FileStamp, Fingerprint
from surfkit.runs import journal
from surfkit.runs.execute.block_state import read_state
from surfkit.runs.folder import SHARED, Run
from surfkit.runs.recipe import Recipe, complete
from surfkit.runs.run_notes import prefix_notes, repeat_warnings
from surfkit.runs.stage_cache import CachedStage, StageCache
from surfkit.scene.scene import View
from surfkit.train.data_cache import needs_priors

PART_FILE_PATTERNS = {
    "pretrain": ("events.jsonl", "pretrain/checkpoint.safetensors"),
    "plan": ("blocks/plan.png", "blocks/plan.json"),
    "tune": (
        "blocks/merge.json",
        "blocks/[0-9]*/events.jsonl",
        "blocks/[0-9]*/state.json",
        "tune/checkpoint.safetensors",
    ),
    "refine": ("{name}/before.json", "{name}/events.jsonl", "{name}/checkpoint.safetensors"),
    "result": ("method/**/*", "result/*", "result/result.json"),
    "mesh": ("mesh_pictures/*", "mesh.*", "mesh-lod*", "mesh.json"),
    "lod": ("lod/*", "lod/lod.json"),
    "compress": ("compressed/model.surfkit", "compressed/compressed.json"),
}
"""Patterns of the files of each part in a run folder; the last one is there only if all are. The checkpoints of the
blocks are not among them, as the merged model holds all that later parts need."""


CODE_SUFFIXES = (".py", ".cu", ".cpp", ".h", ".so")
"""Endings of files with code of a plugin."""
PLAN_FIELDS, TUNE_FIELDS = ("partition", "assign", "min_views", "partition_pretrain"), ("tune", "context")
"""Fields of the recipe that belong to the plan of the blocks, and to tuning them."""
OTHER_FIELDS = ("about", "test_every", "depth", "refine", "mesh", "lod", "compress")
"""Fields with parts of their own, and those that count only where depth maps are looked at, or never."""


@dataclass(frozen=True)
class SharedPart:
    """One part of what a run makes.

    Attributes:
        name: "pretrain", "plan" (of the blocks, with the views of each), "tune" (all blocks, merged), "refine0" and so
            on; "result" of a method without stages; "mesh", "lod" and "compress".
        after: The part that it is made from, if any.
        settings: Plain data: the settings that belong to it.
        needs_prior: Whether it looks at depth maps of the run.
        estimator: What makes it depth maps of its own.
    """

    name: str
    after: str | None
    settings: Any
    needs_prior: bool = False
    estimator: DepthEstimator | None = None


def parts(recipe: Recipe) -> Iterator[SharedPart]:
    """Every part of what a recipe makes, in its order; each one comes after those that it depends on.

    A field of the recipe that no other part has belongs to the first one.
    """
    recipe = load(Recipe, dump(complete(recipe)))  # numbers as they come from a file: 8 and 8.0 are the same
    first = [each.name for each in fields(recipe) if each.name not in (*PLAN_FIELDS, *TUNE_FIELDS, *OTHER_FIELDS)]
    if recipe.has_stages:
        last, needs_prior = "pretrain", recipe.start.needs_prior or needs_priors(recipe.pretrain.losses)
    else:
        last, needs_prior = "result", recipe.method.needs_prior
        first += [name for name in recipe.method.uses if name not in first]
    yield SharedPart(last, None, _settings(recipe, first), needs_prior)
    if recipe.has_stages and recipe.partition is not None:
        other = recipe.partition_pretrain
        yield SharedPart("plan", last, _settings(recipe, PLAN_FIELDS), other is not None and needs_priors(other.losses))
        last = "tune"
        yield SharedPart(last, "plan", _settings(recipe, TUNE_FIELDS), needs_priors(recipe.tune.losses))
    for at, refine in enumerate(recipe.refine):
        own = refine.estimator
        needs_prior = (own is None and needs_priors(refine.stage.losses)) or any(m.needs_prior for m in refine.meshers)
        settings = dump(refine) if own is None else [dump(refine), own.version]
        yield SharedPart(f"refine{at}", last, settings, needs_prior, own)
        last = f"refine{at}"
    if recipe.mesh is not None:
        yield SharedPart("mesh", last, dump(recipe.mesh), recipe.mesh.needs_prior)
    for name in ("lod", "compress"):
        if (wanted := getattr(recipe, name)) is not None:
            yield SharedPart(name, last, dump(wanted))


def _settings(recipe: Recipe, names: Sequence[str]) -> dict[str, Any]:
    return {name: dump(getattr(recipe, name)) for name in names}


def part_keys(recipe: Recipe, inputs: Callable[[SharedPart], Any] = lambda part: None) -> dict[str, str]:
    """By the name of each part, the hash of all that determines it: its settings, its inputs, the parts before.

    Args:
        recipe: The recipe.
        inputs: Plain data on what a part reads; without it, keys tell apart what is made from the same data.
    """
    found: dict[str, str] = {}
    for part in parts(recipe):
        depth = dump(recipe.depth) if part.needs_prior else None
        known = [found.get(part.after or ""), part.name, part.settings, depth, inputs(part)]
        found[part.name] = hashlib.sha256(json.dumps(known).encode()).hexdigest()[:32]
    return found


def versions(recipe: Recipe | None = None) -> dict[str, str]:
    """Of surfkit and of the installed plugins: those whose classes a recipe is made of, or all that offer parts.

    Those of plugins end with a digest of their source files: whoever writes one changes the code more often than the
    version, and finished runs of the old code must not stand for the new.
    """
    if recipe is None:
        counted = [plugin for plugin in records() if plugin.distribution and "surfkit_components" in plugin.hooks]
    else:
        used = set(packages(recipe))
        counted = [plugin for plugin in records() if plugin.distribution and _package(plugin.name) in used]
    return dict(sorted((each.distribution, f"{each.version}{_source_tag(each.name)}") for each in counted))


def packages(value: Any) -> Iterator[str]:
    """Names of the packages that the classes of a value come from, and of its fields and elements at any depth."""
    if is_dataclass(value) and not isinstance(value, type):
        yield from (cls.__module__.partition(".")[0] for cls in type(value).__mro__)
        inner: Iterable[Any] = (getattr(value, each.name) for each in fields(value))
    else:
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else ()
    for each in inner:
        yield from packages(each)


def _package(name: str) -> str:
    """The package that a plugin lies in."""
    module = inspect.getmodule(plugins().get_plugin(name))
    return "" if module is None else module.__name__.partition(".")[0]


def _source_tag(name: str) -> str:
    """What tells the code of an installed plugin from other code of the same version; "" for parts of surfkit."""
    module = inspect.getmodule(plugins().get_plugin(name))
    source: str | None = getattr(module, "__file__", None)
    if name in BUILTIN or module is None or not source:
        return ""
    file = Path(source)
    is_alone = not getattr(module, "__package__", None)
    paths = [file] if is_alone else sorted(each for each in file.parent.rglob("*") if each.suffix in CODE_SUFFIXES)
    found = hashlib.sha256()
    for path in paths:
        found.update(f"\0{path.relative_to(file.parent).as_posix()}\0".encode() + path.read_bytes())
    return f"+{found.hexdigest()[:12]}"


def inputs_of(run: Run, backend: str, prints: Fingerprint, views: Sequence[View] = ()) -> Callable[[SharedPart], Any]:
    """What the parts of a run read, as `part_keys` wants it.

    Args:
        run: With the depth maps that were found or made.
        backend: Name of the rasterizer.
        prints: Of the data.
        views: Of the training photographs, of which files of depth maps are looked for.
    """

    def inputs(part: SharedPart) -> Any:
        photographs, needs_prior = {}, part.needs_prior
        for name, known in prints.photographs.items():
            beside = {what: _content(known.beside[what]) for what in known.beside if what == "mask" or needs_prior}
            photographs[name] = [known.camera, known.size, known.content, known.held_out, beside]
        return {
            "versions": versions(run.recipe) | {"torch": torch.__version__},
            "rasterizer": backend,
            "data": dump(load(Data, dump(replace(run.data, priors=None)))),
            "maps": run.data.priors.name if needs_prior and run.data.priors is not None else None,
            "points": prints.points,
            "photographs": photographs,
            "files": {path: _content(stamp) for path, stamp in prints.files.items()},
            "estimator_files": _files_read(part.estimator, views),
        }

    return inputs


def _files_read(estimator: DepthEstimator | None, views: Sequence[View]) -> list[str]:
    """What tells the files that an estimator reads from others; nothing where they are not there, which
    `refuse_unrefinable` tells if they are needed."""
    with suppress(BadInput):
        return [] if estimator is None else files_of(estimator, views)
    return []


def _content(stamp: FileStamp) -> list[Any]:
    return [stamp.size, stamp.content, stamp.meaning]


@dataclass(frozen=True)
class RunCache:
    """The parts of one run in a store.

    Attributes:
        run: The run.
        store: Where parts lie that any run has made; None shares nothing.
        keys: Of all parts of the run, by name.
        found: Those that the store has and the run folder has not.
    """

    run: Run
    store: StageCache | None = None
    keys: dict[str, str] = field(default_factory=dict)
    found: dict[str, CachedStage] = field(default_factory=dict)

    @classmethod
    def of(
        cls, run: Run, store: StageCache | None, backend: str, prints: Fingerprint, views: Sequence[View]
    ) -> RunCache:
        """Look for the parts of a run in a store; nothing is written."""
        if store is None:
            return cls(run)
        keys, known, found = part_keys(run.recipe, inputs_of(run, backend, prints, views)), read_shared(run.out), {}
        for part in parts(run.recipe):
            has_before = part.after is None or part.after in found or _is_there(run.out, part.after, keys, known)
            if not has_before or _is_there(run.out, part.name, keys, known):
                continue
            if (entry := store.find(keys[part.name])) is not None:
                found[part.name] = entry
        return cls(run, store, keys, found)

    def take(self) -> None:
        """Put what was found into the run folder, with the warnings and the memory that its journals tell of."""
        for name, entry in self.found.items():
            entry.take(self.run.out)
            self._note(name, taken=True)
            for folder, prefix in _journals(self.run.out, name):
                repeat(self.run.out, folder, prefix)
        if self.found and self.store is not None:
            say(f"{self.run.out}: taken from {self.store.folder}, as computed before: {', '.join(self.found)}")

    def keep(self, name: str) -> None:
        """Put a part that is finished into the store, except blocks that were reduced for lack of memory."""
        out = self.run.out
        if self.store is None:
            return
        if name == "tune" and any(read_state(folder).reduced for folder in self.run.blocks.glob("[0-9]*")):
            return
        if not (out / _patterns(name)[-1]).exists():
            return  # it could not be made, which was told
        if not _is_there(out, name, self.keys, read_shared(out)):
            self._note(name, taken=False)
        self.store.put(self.keys[name], out, _files(out, name))

    def _note(self, name: str, taken: bool) -> None:
        known = read_shared(self.run.out)
        write_json(self.run.out / SHARED, known | {name: {"key": self.keys[name], "taken": taken}})


def read_shared(out: Path) -> dict[str, dict[str, Any]]:
    """By name, the key of each part of a run that was put into a store (`taken` false) or taken from it (true)."""
    path = out / SHARED
    return read_json(path, dict[str, dict[str, Any]]) if path.exists() else {}


def repeat(out: Path, folder: Path, prefix: str) -> None:
    """Emit for the run in `out` the warnings and the memory in the journal of a part of it that was taken."""
    with prefix_notes(prefix):
        for line in journal.read(folder / journal.JOURNAL_FILE):
            if line["event"] == "MemoryTaken":
                emit(MemoryTaken(line["parts"], line.get("gpu") or {}))
    repeat_warnings(out, folder, prefix)


def _patterns(name: str) -> list[str]:
    kind = "refine" if name.startswith("refine") else name
    return [pattern.format(name=name) for pattern in PART_FILE_PATTERNS[kind]]


def _files(out: Path, name: str) -> list[str]:
    """Relative paths of the files of a part in a run folder; the one that tells that all are there comes last."""
    *others, last = _patterns(name)
    found = [path for pattern in others for path in sorted(out.glob(pattern)) if path.is_file()]
    names = [path.relative_to(out).as_posix() for path in found if not path.name.startswith(".")]
    return [*(each for each in dict.fromkeys(names) if each != last), last]


def _is_there(out: Path, name: str, keys: dict[str, str], known: dict[str, dict[str, Any]]) -> bool:
    """Whether the folder of a run has a finished part, as its own record says."""
    return known.get(name, {}).get("key") == keys[name] and (out / _patterns(name)[-1]).exists()


def _journals(out: Path, name: str) -> list[tuple[Path, str]]:
    """Folders of the journals of a part, each with what its warnings begin with in the run."""
    if name == "pretrain":
        return [(out, "")]
    if name == "tune":
        return [(folder, f"block {int(folder.name)}: ") for folder in sorted((out / "blocks").glob("[0-9]*"))]
    return [(out / name, f"{name}: ")] if name.startswith("refine") else []
