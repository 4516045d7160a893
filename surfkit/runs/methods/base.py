"""What a method is: a whole way from a scene to a mesh, to splats, or to something else that can draw a view."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from surfkit.core.registry import Component
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh.base import Mesh
from surfkit.primitives.model import SplatModel
from surfkit.raster.api import Maps, Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.scene import Scene, View


@dataclass(frozen=True)
class Reconstruction:
    """What a method made of a scene, in the local frame: one or more of `mesh`, `splats` and `draw`.

    Attributes:
        mesh: Triangles. They are cleaned and written as those of a mesher are. Without any, the mesher of the recipe
            makes some of what can be drawn, where the method has "mesh" among its `uses`.
        splats: Written as point_cloud.ply; they are drawn by the rasterizer where there is no `draw`.
        draw: Maps of a view. Held-out photographs are compared with `color`; a mesher also looks at `alpha`, `depth`,
            `median` and, where there is one, `normal`.
        draw_there: The same, with maps that stay on the device that draws; None for `draw`.
        draw_color: The same as `draw_there` with colours alone, whose speed is measured; None for `draw`.
        draw_of: Draws given splats as `draw` does all of `splats`; None where `draw` is the method's own.
        respond: What the camera of a held-out photograph makes of maps that were drawn of its view: vignetting and
            response curve. None for nothing.
        facts: Plain values for metrics.json, under "method".
        steps: Optimisation steps that were made, of all stages; 0 for a method without any.
        last_steps: Those of the last stage, where there are several.
        seconds: Wall time, of all the processes that have worked on it; None for what surfkit has measured.
        cpu_seconds: CPU time of all threads, likewise.
        peak_memory_bytes: Most memory held, likewise.
        peak_gpu_bytes: Most memory of the GPU held, likewise; 0 without one.
    """

    mesh: Mesh | None = None
    splats: SplatModel | None = None
    draw: Callable[[View], Maps] | None = None
    draw_there: Callable[[View], Maps] | None = None
    draw_color: Callable[[View], Maps] | None = None
    draw_of: Callable[[Splats], Callable[[View], Maps]] | None = None
    respond: Callable[[View, Maps], Maps] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 0
    last_steps: int = 0
    seconds: float | None = None
    cpu_seconds: float | None = None
    peak_memory_bytes: int | None = None
    peak_gpu_bytes: int | None = None

    def photographed(self, draw: Callable[[View], Maps]) -> Callable[[View], Maps]:
        """What draws views as the cameras of held-out photographs take them, from what draws the scene."""
        respond = self.respond
        return draw if respond is None else lambda view: respond(view, draw(view))


@dataclass(frozen=True)
class MethodInput:
    """What a method works with.

    Attributes:
        scene: Training views, sparse points and the frame; held-out views are not there.
        photo: (3, H, W) uint8 photograph of a training view by its position, at the size of its camera; BadInput for
            one that cannot be read. Kept in memory within a budget.
        mask: (H, W) bool by position, False where the photograph is to be ignored; None where all of it counts.
        priors: Estimated depths by position, if the method `needs_prior` and the data set has any or they can be made.
        folder: For files of the method's own, from which an interrupted run goes on. It is there, and stays.
        used: The fields of the recipe that the method `uses`, by name.
        seed: Of every random draw.
        device: Where torch computes.
        rasterizer: Draws splats on the device.
        budget_bytes: Memory to stay within, beside photographs, masks and priors.
        checkpoint_every: Optimisation steps between checkpoints, as the user wants them.
        optimise: Optimises splats in the stages of the recipe; None unless the method uses "pretrain".
    """

    scene: Scene
    photo: Callable[[int], Tensor]
    mask: Callable[[int], Tensor | None]
    priors: Sequence[DepthPrior | None] | None
    folder: Path
    used: Mapping[str, Any]
    seed: int
    device: torch.device
    rasterizer: Rasterizer
    budget_bytes: int
    checkpoint_every: int
    optimise: Callable[[], Reconstruction] | None = None

    @property
    def generator(self) -> torch.Generator:
        """A new generator of random numbers, on the CPU, from the seed."""
        return torch.Generator().manual_seed(self.seed)


class Method(Component):
    """A whole way from a scene to a mesh, or to something that can draw a view. `--steps` sets its `length`.

    Fields of the recipe that it does not name in `uses` must not be set with it; "seed" is always used, and "depth"
    by methods with `needs_prior`.
    """

    uses: ClassVar[tuple[str, ...]] = ()
    """Fields of the recipe that the method looks at, such as "primitive"; "mesh" if what it can draw may be meshed."""
    draws: ClassVar[bool] = True
    """Whether what it makes can draw a view. `surfkit ablate` runs rows of a method without it for their F1 alone."""
    needs_prior: ClassVar[bool] = False
    """Whether it looks at depth priors; they are made as the recipe's `depth` says where the data set has none."""
    needs_normals: ClassVar[bool] = False
    """Whether it looks at their normals too, where there are any."""

    def length(self) -> int | None:
        """Optimisation steps of a whole run, a setting marked as `Steps`; None for a method without any."""
        return None

    def files(self) -> tuple[Path, ...]:
        """Files that it reads beside the data set: a run that has begun is refused with one that has changed."""
        return ()

    def refuse_unfit(self, given: MethodInput) -> None:
        """Look, before anything is written, whether it can work; `given.folder` may not be there yet.

        Raises:
            BadInput: The data do not fit, or a package cannot be loaded on this machine.
        """

    @abstractmethod
    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """Reconstruct the scene, going on from what an interrupted call has left in `given.folder`.

        The run keeps mesh and splats of the result. A `draw` it cannot keep: to measure a finished run again, it calls
        this again, which then is to return at once from what is in the folder.

        Progress is told by `surfkit.core.events`: `StageBegan`, then `StepDone` for each optimisation step, are what
        `surfkit status`, `curves` and TensorBoard show; `Progress` is for work without steps. KeyboardInterrupt stops
        the run, where it is raised; to finish a step first, work within `surfkit.graceful()`, and when its `asked` is
        true, save and raise KeyboardInterrupt.

        Raises:
            BadInput: The scene cannot be reconstructed so.
            KeyboardInterrupt: The run was asked to stop; the same command calls it again.
        """
