"""What a benchmark is made of. `protocols.py` declares those that there are."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from surfkit.apps.benchmark.truths import Needed, TruthFiles
from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.registry import offered_once, unknown
from surfkit.depth.base import DepthEstimator
from surfkit.io.datasets.data import Data, ReadSettings
from surfkit.runs.recipe import Recipe, with_steps
from surfkit.study.ablation import Row, Table

MEAN = "mean"
"""In place of the name of a scene: figures over all scenes of a benchmark."""

WORDS = ("about", "sources", "rules", "published_in")
"""Of a protocol, what decides no figure."""

Figures = Mapping[str, float]
"""Published figures, by the names of `surfkit.study.metric_columns`."""


@dataclass(frozen=True)
class BenchmarkScene:
    """A scene, and how it is read and measured.

    Attributes:
        name: As typed.
        folder: Of the data set, below the root.
        reading: How it is read; paths in it are below the root.
        needed: Files that training reads.
        truth: Files that meshes are measured with.
        training: Least and greatest number of photographs that are trained on; None where nobody has published it.
    """

    name: str
    folder: str
    reading: ReadSettings
    needed: tuple[Needed, ...]
    truth: TruthFiles
    training: tuple[int, int] | None = None

    def data(self, root: Path) -> Data:
        """The data set as the protocol reads it."""
        tests = self.reading.test_data
        reading = self.reading if tests is None else replace(self.reading, test_data=(root / tests).resolve())
        return reading.of((root / self.folder).resolve())


@dataclass(frozen=True)
class Contender:
    """A row of the result: a recipe, the same for all scenes or one for each.

    Attributes:
        label: As typed.
        recipe: Its name, or by scene.
        steps: Optimisation steps, all schedules scaled; those of the recipe if None.
        published: Figures by scene, or of `MEAN`.
        by_default: Trained where nobody names rows. Others have published figures and may be named.
    """

    label: str
    recipe: str | Mapping[str, str]
    steps: int | None = None
    published: Mapping[str, Figures] = field(default_factory=dict)
    by_default: bool = True


@dataclass(frozen=True)
class Protocol:
    """All that decides the figures of a benchmark. Nothing of it is an option. What changes gets a new `version`.

    Attributes:
        name: As typed.
        version: Counts from 1.
        about: In one line.
        scenes: In the order of the table.
        contenders: Rows; any other recipe may be named too, as it is, with the `steps` of the protocol.
        columns: What is measured.
        sources: By key, where files come from, in words and with the address of an official page.
        rules: The rest of the protocol in words, a sentence each.
        published_in: What the published figures are from.
        steps: Of every recipe that makes optimisation steps; those of the contender or of its recipe if None.
        estimator: Of the depth maps that recipes may learn from; None where none are used but those that recipes make.
    """

    name: str
    version: int
    about: str
    scenes: tuple[BenchmarkScene, ...]
    contenders: tuple[Contender, ...]
    columns: tuple[str, ...]
    sources: Mapping[str, str]
    rules: tuple[str, ...]
    published_in: str
    steps: int | None = None
    estimator: DepthEstimator | None = None

    @property
    def tag(self) -> str:
        """Name and version, by which figures are compared."""
        return f"{self.name}-{self.version}"

    @property
    def digest(self) -> str:
        """Twelve hex digits of the declaration without words and published figures: another one must have another
        version."""
        parts = {name: it for name, it in dump(self).items() if name not in WORDS}
        parts["contenders"] = [(each.label, dump(each.recipe), each.steps) for each in self.contenders]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]

    def chosen_scenes(self, names: Sequence[str]) -> tuple[BenchmarkScene, ...]:
        """Those that are named, in the order of the protocol; all if none is.

        Raises:
            BadInput: There is no such scene.
        """
        known = [scene.name for scene in self.scenes]
        for name in names:
            if name not in known:
                raise BadInput(f"--scenes: {unknown('scene', name, known)}")
        return tuple(scene for scene in self.scenes if scene.name in names or not names)

    def chosen_contenders(self, names: Sequence[str]) -> tuple[Contender, ...]:
        """Rows by name: of the protocol, or of any recipe; those by default if none is named.

        Raises:
            BadInput: There is no such row and no such recipe, or it is named twice.
        """
        if not names:
            return tuple(each for each in self.contenders if each.by_default)
        own, offered = {each.label: each for each in self.contenders}, offered_once("surfkit_recipes", "a recipe")
        if twice := next((name for at, name in enumerate(names) if name in names[:at]), None):
            raise BadInput(f"--recipes: {twice} is there twice; name each once")
        if wrong := next((name for name in names if name not in own and name not in offered), None):
            raise BadInput(f"--recipes: {unknown('recipe', wrong, [*own, *(n for n in offered if n not in own)])}")
        return tuple(own.get(name) or Contender(name, name) for name in names)

    def recipe(self, contender: Contender, scene: BenchmarkScene) -> Recipe:
        """What a row trains on a scene.

        Raises:
            BadInput: No package that is installed offers the recipe, or it cannot take the steps of the protocol.
        """
        name = contender.recipe if isinstance(contender.recipe, str) else contender.recipe[scene.name]
        offered = offered_once("surfkit_recipes", "a recipe")
        if name not in offered:
            raise BadInput(f"{self.tag}, {contender.label}: {unknown('recipe', name, offered)}; install its plugin")
        recipe: Recipe = offered[name]
        steps = contender.steps or self.steps
        return recipe if steps is None or recipe.length is None else with_steps(recipe, steps)

    def table(self, scene: BenchmarkScene, contenders: Sequence[Contender]) -> Table:
        """The rows of a scene, each a recipe of its own."""
        rows = [
            Row(
                each.label,
                kept=False,
                paper=each.published.get(scene.name, {}),
                recipe=self.recipe(each, scene),
            )
            for each in contenders
        ]
        return Table(f"{self.tag}-{scene.name}", f"{self.about}: {scene.name}", rows[0].recipe or Recipe(), tuple(rows))
