"""The two branches, a signed distance beside splats, and their joint optimisation, from where it has stopped."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import torch
from surfkit_neus.batches import Batches
from surfkit_neus.box import SceneBox
from surfkit_neus.gradients import Geometry
from surfkit_neus.method import NeuralSurface
from surfkit_neus.state import State
from surfkit_neus.train import descend
from torch import Tensor

from surfkit.core.memory import peak_memory_bytes
from surfkit.plugin import (
    CompletedStep,
    Diverged,
    Fault,
    MethodInput,
    Points,
    Stage,
    StageBegan,
    StageState,
    StartInput,
    StepDone,
    Trainer,
    checkpoint,
    emit,
    graceful,
)

if TYPE_CHECKING:
    from surfkit_sdf_splats.method import SplatsWithDistance

SPLATS = "splats.safetensors"
Item = TypeVar("Item")


@dataclass
class Surface:
    """The branch of the signed distance, as the splats see it.

    Attributes:
        settings: Of the branch.
        state: Its fields, with their optimiser.
        box: Their frame.
        batches: Draws pixels of photographs.
        alone: Steps of the splats before the first of this branch.
    """

    settings: NeuralSurface
    state: State
    box: SceneBox
    batches: Batches
    alone: int

    @property
    def index(self) -> int:
        """The coming step of this branch, from 1."""
        return self.state.index + 1

    @property
    def device(self) -> torch.device:
        """Where the fields are."""
        return self.state.field.log_sharpness.device

    def inward(self, local: Tensor) -> Tensor:
        """(P, 3) float32 positions in the box, on its device, of (P, 3) positions in the local frame."""
        return self.box.inward(local.detach().cpu()).float().to(self.device)

    def geometry(self, x: Tensor) -> Geometry:
        """The field at (P, 3) positions in the box, as the coming step looks at it."""
        return self.settings.look(self.index).geometry(self.state.field, x)

    @torch.no_grad()
    def distances(self, local: Tensor) -> Tensor:
        """(P,) signed distances, in units of the box, of (P, 3) positions in the local frame; inf outside the box."""
        x = self.inward(local)
        found = self.state.field(x, self.settings.look(self.index).levels)[0]
        return torch.where(self.box.holds(x), found, torch.inf).to(local)


class Link(ABC):
    """What ties both branches together in a step: parts of the splats' stage that look at the surface, and terms of the
    surface that look at the splats."""

    @abstractmethod
    def tied(self, stage: Stage) -> Stage:
        """The stage of the splats, with the parts that look at the surface."""

    @abstractmethod
    def losses(self, done: CompletedStep) -> dict[str, Tensor]:
        """Weighted losses of the surface, after a step of the splats."""


class ByPosition(Sequence[Item]):
    """A function of positions as a sequence."""

    def __init__(self, get: Callable[[int], Item], count: int) -> None:
        self.get, self.length = get, count

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, at: int) -> Item:  # type: ignore[override]
        return self.get(at)


def train(method: SplatsWithDistance, given: MethodInput, box: SceneBox) -> tuple[StageState, State]:
    """Splats and surface after the last step; no step is made where the folder has them.

    Raises:
        BadInput: The checkpoint in the folder cannot be used, or a photograph.
        Fault: The losses are NaN or Inf.
        KeyboardInterrupt: The run was asked to stop; the state is saved.
    """
    surface = Surface(
        method.surface,
        method.surface.begin(box, given.seed, given.device),
        box,
        Batches(given, box, method.surface.rays, method.surface.photos),
        method.splats.steps - method.surface.steps,
    )
    count = len(given.scene.train)
    photos, masks = ByPosition(given.photo, count), ByPosition(given.mask, count)
    link = method.link(surface)
    stage = link.tied(method.splats)
    trainer = Trainer(stage, given.used["primitive"], given.scene.train, photos, given.rasterizer, given.priors, masks)
    found = checkpoint.load_last(given.folder / SPLATS)
    if found is None:
        splats = _begun(trainer, given, StartInput(given.scene, photos, masks, given.priors, given.generator))
    else:
        splats = found[0]
        splats.move(given.rasterizer.where())
        surface.state.read(_surface_file(given.folder, splats.index))
    steps = stage.steps
    if splats.index == steps:
        return splats, surface.state
    emit(StageBegan("joint", steps, len(splats.points), first=splats.index + 1))
    with graceful() as request:
        while splats.index < steps:
            told = _step(trainer, splats, surface, link)
            if splats.index == steps or request.asked or _due(splats.index, given.checkpoint_every):
                _save(given.folder, splats, surface.state)
            emit(StepDone(splats.index, steps, told, len(splats.points), peak_memory_bytes()))
            if request.asked:
                raise KeyboardInterrupt
    return splats, surface.state


def _begun(trainer: Trainer, given: MethodInput, known: StartInput) -> StageState:
    generator = given.generator
    start = given.used["start"].model(trainer.primitive, known, generator)
    points = Points.fresh(start.params, trainer.primitive.shared())
    points.stats.update(start.stats)
    state = trainer.begin(points, generator)
    state.sh_degree = min(start.sh_degree, trainer.primitive.sh_degree)
    return state


def _step(trainer: Trainer, splats: StageState, surface: Surface, link: Link) -> Mapping[str, float]:
    """One step of the splats, and one of the surface if it is its time; the losses of both."""
    try:
        done = trainer.step(splats)
    except Diverged as error:
        raise Fault(
            f"{error}; the last checkpoint is kept. Lower method.splats.rates, and train in a new folder"
        ) from (error)
    if splats.index <= surface.alone:
        return done.losses
    told = descend(surface.settings, surface.state, link.losses(done))
    return done.losses | {f"surface {name}": value for name, value in told.items()}


def _due(index: int, every: int) -> bool:
    return bool(every) and index % every == 0


def _save(folder: Path, splats: StageState, surface: State) -> None:
    """Write both states; that of the splats last, as its step says which file of the surface belongs to it."""
    surface.write(_surface_file(folder, splats.index))
    checkpoint.save(folder / SPLATS, splats)
    for old in sorted(folder.glob("surface-*.safetensors"))[:-2]:  # the splats have their last two states, too
        old.unlink()


def _surface_file(folder: Path, index: int) -> Path:
    return folder / f"surface-{index:09d}.safetensors"


def counted(rows: Tensor, values: Tensor) -> Tensor:
    """Mean of (P,) values over the (P,) rows that count, a weight each; 0 where none does."""
    return (values * rows).sum() / rows.sum().clamp_min(1e-6)
