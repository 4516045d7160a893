"""What a run is made of."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import Annotated, Any, Literal

import tyro

from surfkit.compress.base import Compressor
from surfkit.compress.levels.base import LevelsOfDetail
from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.registry import choice, components, name_of
from surfkit.core.schedule import rescale
from surfkit.depth.base import DepthEstimator
from surfkit.io.datasets.data import TEST_EVERY
from surfkit.losses.base import Loss, Regularizer
from surfkit.losses.consensus import Consensus
from surfkit.mesh.base import Mesher
from surfkit.partition.assign import Assign, SSIMDifference
from surfkit.partition.base import Partition
from surfkit.primitives.base import Primitive
from surfkit.primitives.columns import RATES
from surfkit.primitives.drawing import draws_itself
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.runs.methods.base import Method
from surfkit.runs.methods.splat_optimisation import SplatOptimisation
from surfkit.start.base import Start
from surfkit.start.simple_starts import SparseStart
from surfkit.train.refine.base import Refine
from surfkit.train.stage import MAX_STAGE_STEPS, Stage

Context = Literal["densified", "tuned", "frozen"]
"""What becomes of the points around a block while it is tuned."""


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a result, and nothing that does not."""

    about: Annotated[str, tyro.conf.Suppress] = ""
    """What the recipe is, in one line."""

    test_every: Annotated[int, tyro.conf.Suppress] = TEST_EVERY
    """Photographs that `surfkit train` holds out where --test-every does not say: every Nth; 0 for none, as for a
    surface to deliver. It belongs to that command: in Python and in ablation tables, `Data` says what is held out."""

    method: Annotated[Method, choice(Method)] = SplatOptimisation()
    """How the scene is reconstructed as a whole. Other methods than `splats` leave out most settings below: those that
    they do not use are refused."""

    primitive: Annotated[Primitive, choice(Primitive)] = Surfel2D()
    """What the scene is made of."""

    depth: Annotated[DepthEstimator | None, choice(DepthEstimator, optional=True)] = None
    """How depth maps are made for recipes that need priors where the data set has none; none makes none."""

    start: Annotated[Start, choice(Start)] = SparseStart()
    """Where the points of pretraining begin."""

    pretrain: Stage = field(default_factory=Stage)
    """Optimisation of the whole scene."""

    partition: Annotated[Partition | None, choice(Partition, optional=True)] = None
    """How the scene is cut into blocks that are tuned separately, after pretraining; none keeps it whole."""

    partition_pretrain: Stage | None = None
    """Where the scene is cut: a pretraining of its own, from the same start, whose model decides where the blocks lie
    and which views they are tuned on; none takes the model of pretrain. The blocks begin with that of pretrain."""

    assign: Annotated[Assign, choice(Assign)] = SSIMDifference()
    """Which views a block is tuned on, where the scene is cut."""

    min_views: Annotated[int, tyro.conf.arg(name="min-views")] = 50
    """A block with fewer views is joined to a neighbour; in a small scene a quarter of an even share is enough."""

    tune: Stage = field(default_factory=Stage)
    """Optimisation of each block, where the scene is cut."""

    context: Context = "densified"
    """What happens to the points outside a block that its views show: they are densified like its own, tuned but
    neither cloned nor split, or frozen as they are in the coarse model. In no case are they merged: only points whose
    position is in the block are its own."""

    refine: tuple[Annotated[Refine, choice(Refine)], ...] = ()
    """What the whole model goes through when it is trained, and its blocks merged if there are any; refine.0:NAME adds
    the first, refine.1:NAME the next, refine.0:none drops one."""

    mesh: Annotated[Mesher | None, choice(Mesher, optional=True)] = None
    """How the splats become triangles when they are trained; none for splats alone."""

    compress: Annotated[Compressor | None, choice(Compressor, optional=True)] = None
    """How the trained model is compressed into compressed/model.surfkit; none makes no such file."""

    lod: Annotated[LevelsOfDetail | None, choice(LevelsOfDetail, optional=True)] = None
    """How levels of detail are made of the model, for cameras that see it from afar; none makes none."""

    seed: int = 0
    """Random seed."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**63:
            raise BadInput(f"seed is {self.seed}; it must be 0 or more and below 2^63")
        if self.test_every < 0:
            raise BadInput(f"test_every is {self.test_every}; it must be 0 (hold out none) or more")
        if self.min_views < 1:
            raise BadInput(f"min_views is {self.min_views}; a block needs 1 or more")
        for at, refine in enumerate(self.refine):
            blind = [name for name, loss in refine.stage.losses.items() if refine.taught and loss.needs_prior]
            if blind:
                raise BadInput(f"refine.{at}: learns from what the model draws, where {blind[0]} finds no depth priors")

    def stages(self) -> Iterator[tuple[str, Stage, Primitive]]:
        """Every stage in its order: its path in the recipe, the stage, and the primitive of its points."""
        yield "pretrain", self.pretrain, self.primitive
        if self.partition is not None:
            if self.partition_pretrain is not None:
                yield "partition_pretrain", self.partition_pretrain, self.primitive
            yield "tune", self.tune, self.primitive
        primitive = self.primitive
        for at, refine in enumerate(self.refine):
            primitive = refine.primitive(primitive)
            yield f"refine.{at}.stage", refine.stage, primitive

    def refuse_unfit(self) -> None:
        """BadInput if parts do not fit together; a note of learning rates that are not used."""
        if self.partition_pretrain is not None and self.partition is None:
            raise BadInput(
                "partition_pretrain: the recipe cuts the scene into no blocks; leave it out, or choose partition"
            )
        before = self.primitive
        for at, refine in enumerate(self.refine):
            try:
                refine.refuse_unfit(before)
            except BadInput as error:
                raise BadInput(f"refine.{at}: {error}") from error
            before = refine.primitive(before)
        if self.lod is not None:
            try:
                self.lod.refuse_unfit(before)
            except BadInput as error:
                raise BadInput(f"lod: {error}") from error
        for path, stage, primitive in self.stages():
            refuse_unfit_stage(path, stage, primitive)
            for key in (key for key, term in stage.regularizers.items() if isinstance(term, Consensus)):
                self._refuse_consensus(f"{path}.regularizers.{key}", path, stage)

    def _refuse_consensus(self, where: str, path: str, stage: Stage) -> None:
        """BadInput where blocks could not agree: points must stay the same ones, and be tuned by several blocks."""
        if path != "tune":
            raise BadInput(f"{where}: only blocks agree; give it to tune.regularizers, in a recipe with a partition")
        if sum(isinstance(term, Consensus) for term in stage.regularizers.values()) > 1:
            raise BadInput(f"{where}: there are several of them; leave all but one out")
        if stage.policies:
            raise BadInput(
                f"{where}: blocks agree on points, so none may be added or removed; choose tune.densify:none, and no "
                "tune.prune"
            )
        if self.context == "frozen":
            raise BadInput(f"{where}: with --context frozen no point is tuned by two blocks; choose tuned")

    @property
    def meshers(self) -> tuple[Mesher, ...]:
        """Everything that makes a mesh: what the recipe refines with, then the one of the result."""
        used = [mesher for refine in self.refine for mesher in refine.meshers]
        return (*used, *([] if self.mesh is None else [self.mesh]))

    @property
    def has_stages(self) -> bool:
        """Whether splats are optimised in the stages of the recipe."""
        return "pretrain" in self.method.uses

    @property
    def without_appearance(self) -> list[str]:
        """Dotted paths of the appearances of stages that take the colours of all photographs as they are."""
        stages = {"pretrain": self.pretrain} if self.has_stages else {}
        stages |= {"tune": self.tune} if self.has_stages and self.partition is not None else {}
        return [f"{name}.appearance" for name, stage in stages.items() if stage.appearance is None]

    @property
    def looks_for_uneven_light(self) -> list[str]:
        """Appearances of stages that change colours only where the light is uneven, as on the command line."""
        stages = self.stages() if self.has_stages else ()
        found = ((path, stage.appearance) for path, stage, _ in stages)
        return [
            f"{path}.appearance:{name_of(model)}" for path, model in found if model is not None and model.only_if_uneven
        ]

    @property
    def length(self) -> int | None:
        """Optimisation steps of the first stage, or of the whole method; None if there are none."""
        return self.pretrain.steps if self.has_stages else self.method.length()

    @property
    def unused(self) -> tuple[str, ...]:
        """Names of the fields that the method does not use."""
        used = {"about", "test_every", "method", "seed", *self.method.uses, *["depth"] * self.method.needs_prior}
        return tuple(each.name for each in fields(self) if each.name not in used)


def _refuse_weights(path: str, stage: Stage) -> None:
    """BadInput for a weight that is not finite or below 0, with which a term would be left out without a word."""
    terms: dict[str, Loss | Regularizer] = {f"losses.{key}": loss for key, loss in stage.losses.items()}
    terms |= {f"regularizers.{key}": term for key, term in stage.regularizers.items()}
    for key, term in terms.items():
        for index in (1, stage.steps):
            weight: Any = term.weight_at(index, stage.steps)
            if not (isinstance(weight, Real) and 0 <= float(weight) < math.inf):
                shown = f"{weight:g}" if isinstance(weight, Real) else repr(weight)
                raise BadInput(f"{path}.{key}: its weight in step {index} is {shown}; it must be 0 or more, and finite")


def _refuse_no_loss(path: str, stage: Stage) -> None:
    """BadInput for a stage in which no loss counts at its beginning, middle or end: nothing would be learnt."""
    if not any(stage.weights_at(index) for index in (1, (stage.steps + 1) // 2, stage.steps)):
        left = f"{', '.join(stage.losses)} have a weight of 0" if stage.losses else "none is left"
        raise BadInput(
            f"{path}.losses: {left}, so nothing would be learnt from the photographs; add {path}.losses.l1:l1"
        )


def refuse_unfit_stage(path: str, stage: Stage, primitive: Primitive) -> None:
    """BadInput if a stage at a path in the recipe does not fit the primitive; a note of learning rates that are not
    used."""
    _refuse_weights(path, stage)
    _refuse_no_loss(path, stage)
    columns = primitive.columns()
    lacking = [name for name in stage.rates if name not in columns]
    if unknown := [name for name in lacking if name not in RATES]:
        raise BadInput(
            f"{path}.rates.{unknown[0]}: primitive {name_of(primitive)} has no such column; it has {', '.join(columns)}"
        )
    if lacking:
        emit(Warned(f"{path}.rates: {', '.join(lacking)} not used, as primitive {name_of(primitive)} has none"))
    if stage.signal.absolute and not primitive.has_absolute_gradients:
        raise BadInput(
            f"{path}.signal: {name_of(stage.signal)} wants absolute pixel gradients, and primitive "
            f"{name_of(primitive)} draws itself without them; choose {path}.signal:loss-gradient, or another primitive"
        )
    if stage.densify is not None and not primitive.has_free_points:
        raise BadInput(
            f"{path}.densify: the points of primitive {name_of(primitive)} can be neither copied nor split; leave it "
            f"out ({path}.densify:none), or choose another primitive"
        )
    if stage.densify is not None and stage.densify.needs_absolute and not stage.signal.absolute:
        raise BadInput(
            f"{path}.densify: {name_of(stage.densify)} needs absolute pixel gradients, and signal "
            f"{name_of(stage.signal)} has none; choose {path}.signal:abs-gradient, or another densify"
        )
    if stage.densify is not None and stage.densify.needs_pixels and draws_itself(primitive):
        raise BadInput(
            f"{path}.densify: {name_of(stage.densify)} needs the weights that points are blended with, and primitive "
            f"{name_of(primitive)} draws itself without them; choose {path}.densify:adc, or another primitive"
        )
    if stage.densify is not None and stage.densify.needs_leading and not primitive.tells_leading:
        raise BadInput(
            f"{path}.densify: {name_of(stage.densify)} asks which points lead in a pixel, and primitive "
            f"{name_of(primitive)} does not tell; choose {path}.densify:adc, or another primitive"
        )
    for prune in stage.prune:
        prune.refuse_unfit(path, stage, primitive)
    stage.optimizer.refuse_unfit(path, stage, primitive)
    if stage.appearance is not None:
        stage.appearance.refuse_unfit(primitive)
        used = {name for index in (1, (stage.steps + 1) // 2, stage.steps) for name in stage.weights_at(index)}
        if stage.appearance.spares_structure and not any(stage.losses[name].of_structure for name in used):
            raise BadInput(
                f"{path}.appearance: {name_of(stage.appearance)} leaves the colours of the scene to losses of "
                f"structure, and only {', '.join(sorted(used))} count; add {path}.losses.ssim:ssim, or choose another "
                f"appearance"
            )


def complete(recipe: Recipe, primitive: str | None = None) -> Recipe:
    """The recipe with every learning rate written out: those of the primitive, unless a stage has others.

    Args:
        recipe: To complete.
        primitive: Name of the primitive that takes the place of its own, if another one does.
    """

    if not recipe.has_stages:
        return recipe

    def with_rates(stage: Stage, primitive: Primitive) -> Stage:
        known = {name: column.rate for name, column in primitive.columns().items()}
        return replace(stage, rates=known | stage.rates)

    kind = None if primitive is None else components(Primitive).get(primitive)
    found = recipe.primitive
    if kind is not None and kind is not type(found):
        found = kind()
    pretrain, tune = with_rates(recipe.pretrain, found), with_rates(recipe.tune, found)
    planned = None if recipe.partition_pretrain is None else with_rates(recipe.partition_pretrain, found)
    refined = []
    for refine in recipe.refine:
        found = refine.primitive(found)
        refined.append(replace(refine, stage=with_rates(refine.stage, found)))
    return replace(recipe, pretrain=pretrain, partition_pretrain=planned, tune=tune, refine=tuple(refined))


def without_unused(recipe: Recipe) -> Recipe:
    """The recipe with the fields that its method does not use at their defaults, as after a change of the method."""
    plain = Recipe()
    return replace(recipe, **{name: getattr(plain, name) for name in recipe.unused})


def refuse_unused(recipe: Recipe) -> None:
    """BadInput if a field is set that the method does not use."""
    plain = Recipe()
    for name in recipe.unused:
        if getattr(recipe, name) != getattr(plain, name):
            raise BadInput(unused(recipe, name))


def unused(recipe: Recipe, setting: str) -> str:
    """What is said of a setting that the method does not use."""
    return f"{setting}: method:{name_of(recipe.method)} does not use it; leave it out, or choose method:splats"


def with_steps(recipe: Recipe, steps: int) -> Recipe:
    """The recipe as a run of `steps` steps, every schedule scaled along."""
    if not 1 <= steps <= MAX_STAGE_STEPS:
        raise BadInput(f"--steps {steps}: give 1 to {MAX_STAGE_STEPS}")
    if recipe.has_stages:
        return rescale(recipe, steps / recipe.pretrain.steps)
    name = f"method:{name_of(recipe.method)}"
    if recipe.length is None:
        raise BadInput(f"--steps {steps}: {name} makes no optimisation steps; leave it out")
    scaled = replace(recipe, method=rescale(recipe.method, steps / recipe.length))
    if scaled.length != steps:
        raise BadInput(f"--steps {steps}: {name} does not scale its steps; set them among its own settings, --method.*")
    return scaled
