"""NeuS and Neuralangelo as methods: their settings, their schedules, and how a run goes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.memory import size
from surfkit.plugin import (
    BadInput,
    Interval,
    Mesh,
    Method,
    MethodInput,
    Reconstruction,
    Steps,
    Warned,
    emit,
    require_within,
)
from surfkit_neus.batches import Batch
from surfkit_neus.box import Rays, SceneBox, scene_box
from surfkit_neus.field import BackgroundField, Networks, SurfaceField
from surfkit_neus.hashgrid import Grid
from surfkit_neus.losses import color_loss, curvature_loss, depth_loss, eikonal_loss, points_loss
from surfkit_neus.mesh import field_mesh, read_mesh, write_mesh
from surfkit_neus.render import Drawn, Look, Samples, draw_rays, draw_view
from surfkit_neus.state import State
from surfkit_neus.train import train

ADAM_BYTES = 16
"""Of a learned number in float32: itself, its gradient and two moments."""
LAYER = 3
"""Numbers kept for the backward pass, for each neuron of a layer."""
DRAWN = 4
"""Rays that are drawn at once, without a backward pass, for each ray of an optimisation step."""


@dataclass(frozen=True)
class NeuralSurface(Method):
    """A neural signed distance function, rendered as a volume; settings that its forms share."""

    steps: Steps = 30_000
    """Optimisation steps."""

    rays: int = 128
    """Pixels in a step; memory and time of a step grow with it."""

    photos: int = 4
    """Photographs that these are drawn from."""

    samples: Samples = Samples()
    """Positions that are looked at on each ray."""

    grid: Grid = Grid()
    """Hash grid of the scene."""

    networks: Networks = Networks()
    """Networks behind it."""

    background: Grid = Grid(levels=6, table_bits=14, coarsest=8, finest=128)
    """Hash grid of what lies beyond the scene box, all of space."""

    margin: float = 0.1
    """The scene box reaches beyond the sparse points by this share of its sides, upwards of the longest one."""

    rate: float = 1e-3
    """Learning rate of the networks."""

    grid_rate: float = 1e-2
    """Learning rate of the hash grids."""

    warm_up: Steps = 500
    """Steps until learning rates have risen to these."""

    decay: float = 0.0
    """Weight decay, as a share of the learning rate."""

    sharpness: float = 20.0
    """The first s of the logistic density, 1 / half the longest side of the scene box; it is learned."""

    eikonal: float = 0.1
    """Weight of the eikonal loss: gradients of a distance have length 1."""

    points: float = 0.0
    """Weight of the distance at sparse points, which is to be 0; as published there is none."""

    prior: float = 0.0
    """Weight of the difference to depth priors; as published there is none. Above 0, maps are made where the data set
    has none and a depth estimator is chosen."""

    cells: int = 256
    """Cells of the lattice of the mesh, along the longest side of the scene box."""

    def __post_init__(self) -> None:
        require_within({"rays": (1, 2**20), "photos": (1, 2**20), "cells": (2, 2**14), "margin": (0, 10)}, self)
        require_within({"rate": (1e-12, 1), "grid_rate": (1e-12, 1), "decay": (0, 1), "warm_up": (0, 2**31)}, self)
        require_within({"sharpness": (1e-3, 1e5), "steps": (1, 2**31)}, self)
        require_within(dict.fromkeys(("eikonal", "points", "prior"), (0, 1e6)), self)

    @property
    def needs_prior(self) -> bool:  # type: ignore[override]
        """See `Method.needs_prior`."""
        return self.prior > 0

    def look(self, index: int) -> Look:
        """How the field is evaluated in step `index` of 1..`steps`."""
        return Look()

    def slowed(self, index: int) -> float:
        """What the learning rates are multiplied by in step `index`, beside the warm-up."""
        return 1.0

    def rates(self, index: int, names: list[str]) -> dict[str, float]:
        """Learning rates of parameters in step `index`, by their names."""
        share = min(1.0, index / self.warm_up if self.warm_up else 1.0) * self.slowed(index)
        return {name: share * (self.grid_rate if name.endswith("table") else self.rate) for name in names}

    def losses(self, field: SurfaceField, drawn: Drawn, batch: Batch, index: int) -> dict[str, Tensor]:
        """Weighted losses of a batch."""
        found = {
            "color": color_loss(drawn.color, batch.color, batch.weight),
            "eikonal": self.eikonal * eikonal_loss(drawn.geometry.gradient, drawn.inside),
        }
        if self.points and len(batch.points):
            found["points"] = self.points * points_loss(field(batch.points, self.look(index).levels)[0])
        if self.prior:
            depth = batch.rays.depth * drawn.distance / drawn.alpha.clamp_min(1e-3)
            found["prior"] = self.prior * depth_loss(depth, batch.depth, batch.confidence * batch.weight)
        return found

    def length(self) -> int:
        """See `Method.length`."""
        return self.steps

    def refuse_unfit(self, given: MethodInput) -> None:
        """See `Method.refuse_unfit`."""
        scene_box(given.scene, self.margin)
        if self.prior and given.priors is None:
            raise BadInput(
                "method.prior is set, and there are no depth maps that can be used; choose an estimator such as "
                "depth:patch-match, or leave it at 0"
            )
        if (wanted := self.bytes()) > given.budget_bytes:
            raise BadInput(
                f"a step of {self.rays} rays would take about {size(wanted)}, and there are "
                f"{size(given.budget_bytes)}; lower method.rays, method.samples or method.grid.table-bits, or "
                "raise --cache"
            )

    def bytes(self) -> int:
        """Memory that training takes, about; measured to within a quarter."""
        networks = self.networks
        distance = 14 * self.grid.levels * self.grid.features + LAYER * networks.width * networks.distance_layers
        evaluations = 3 if self.look(1).step is None else 7  # one with the graph of its gradient, or seven
        kept = evaluations * distance + LAYER * networks.width * networks.color_layers
        return ADAM_BYTES * (self.grid.size + self.background.size) + 4 * kept * self._positions(self.rays)

    def _positions(self, rays: int) -> int:
        return rays * self.samples.in_all

    def begin(self, box: SceneBox, seed: int, device: torch.device) -> State:
        """The fields before the first step."""
        draw = torch.Generator().manual_seed(seed)
        field = SurfaceField(self.grid, self.networks, box.shape, box.level, self.sharpness, draw)
        return State.begin(field.to(device), BackgroundField(self.background, self.networks, draw).to(device))

    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """See `Method.reconstruct`."""
        box = scene_box(given.scene, self.margin)
        state = train(self, given, box)
        look, at_once = self.look(self.steps), DRAWN * self.rays

        def draw_some(rays: Rays) -> Drawn:
            return draw_rays(state.field, state.background, rays, self.samples, look)

        return Reconstruction(
            mesh=self.mesh(given, box, state),
            draw=lambda view: draw_view(draw_some, view, box, given.device, at_once),
            facts={"initial_shape": box.shape, "sharpness": state.field.sharpness.item(), "levels": look.levels},
            steps=self.steps,
        )

    def mesh(self, given: MethodInput, box: SceneBox, state: State) -> Mesh | None:
        """The surface of the trained field, made once and kept in the folder; None, with a warning, without a face."""
        path = given.folder / "mesh.npz"
        if not path.exists():
            at_once = self._positions(DRAWN * self.rays)
            write_mesh(
                path, field_mesh(state.field, box, given.scene.train, self.look(self.steps), self.cells, at_once)
            )
        mesh = read_mesh(
            path, facts={"cells": self.cells, "side": 2 / self.cells * box.scale / given.scene.frame.scale}
        )
        if len(mesh.faces):
            return mesh
        emit(Warned("the signed distance is 0 nowhere that a view sees, so there is no mesh; train longer"))
        return None


@dataclass(frozen=True)
class NeuS(NeuralSurface):
    """A neural signed distance function with analytic gradients (NeuS, Wang et al. 2021), on a hash grid."""

    anneal: Steps = 5_000
    """Steps until sections of a ray along which the distance rises weigh nothing any more."""

    slowest: float = 0.05
    """Share of the learning rates that is left at the end, reached along a cosine."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within({"anneal": (0, 2**31), "slowest": (0, 1)}, self)

    def look(self, index: int) -> Look:
        """See `NeuralSurface.look`."""
        return Look(anneal=min(1.0, index / self.anneal) if self.anneal else 1.0)

    def slowed(self, index: int) -> float:
        """See `NeuralSurface.slowed`."""
        share = max(0.0, (index - self.warm_up) / max(1, self.steps - self.warm_up))
        return self.slowest + (1 - self.slowest) * 0.5 * (1 + math.cos(math.pi * min(1.0, share)))


@dataclass(frozen=True)
class Neuralangelo(NeuralSurface):
    """A neural signed distance function from coarse to fine (Neuralangelo, Li et al. 2023).

    Its gradients are numerical, and a curvature loss keeps it smooth.
    """

    rays: int = 64
    """Pixels in a step; each sample evaluates the field seven times."""

    decay: float = 1e-2
    """Weight decay, as a share of the learning rate."""

    warm_up: Steps = 300
    """Steps until learning rates and the curvature loss have risen to their full size."""

    first_level: int = 4
    """Levels of the hash grid that are used from the first step."""

    every: Interval = 300
    """Steps after which one more level is used; the step of the numerical gradients is the cell of the last one."""

    curvature: float = 5e-4
    """Weight of the curvature loss at the first levels; it falls with the side of the cells."""

    drops: tuple[Steps, Steps] = (18_000, 24_000)
    """Steps after which the learning rates fall to a tenth."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within({"every": (1, 2**31), "curvature": (0, 1e6)}, self)
        require_within({"first_level": (1, self.grid.levels)}, self)

    def levels(self, index: int) -> int:
        """Levels of the hash grid that are used in step `index`."""
        return min(self.grid.levels, self.first_level + (index - 1) // self.every)

    def look(self, index: int) -> Look:
        """See `NeuralSurface.look`."""
        levels = self.levels(index)
        return Look(levels=levels, step=self._cell(levels))

    def _cell(self, levels: int) -> float:
        return 2.0 / self.grid.resolutions[levels - 1]

    def slowed(self, index: int) -> float:
        """See `NeuralSurface.slowed`."""
        return 0.1 ** sum(index > drop for drop in self.drops)

    def losses(self, field: SurfaceField, drawn: Drawn, batch: Batch, index: int) -> dict[str, Tensor]:
        """See `NeuralSurface.losses`."""
        found = super().losses(field, drawn, batch, index)
        assert drawn.geometry.laplacian is not None, "gradients are numerical"
        finer = self._cell(self.levels(index)) / self._cell(self.first_level)
        weight = self.curvature * min(1.0, index / self.warm_up if self.warm_up else 1.0) * finer
        return found | {"curvature": weight * curvature_loss(drawn.geometry.laplacian, drawn.inside)}
