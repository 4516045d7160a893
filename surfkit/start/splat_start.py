"""Start from splats that are there already."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch

from surfkit.core.events import Warned, emit
from surfkit.core.registry import name_of
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.models import existing_model, model_file, read_sound, warn_of_no_fit
from surfkit.io.splats.splat_files import untold_drawing
from surfkit.io.splats.splat_table import SURFEL_SCALE_RATIO, SplatTable
from surfkit.primitives.base import Primitive
from surfkit.primitives.raw import cloud_of
from surfkit.scene.scene import Scene, SparsePoints
from surfkit.start.base import InitialModel, Start, StartInput
from surfkit.start.guess_axes import read_in_scene

DRAWN_AS = (
    "--primitive.antialias --primitive.dilation 0.1 draws them as Mip-Splatting, and --primitive.geometry ray as "
    "Gaussian Opacity Fields"
)
"""What a user can do about splats of which no file says how they are drawn."""


@dataclass(frozen=True)
class SplatStart(Start):
    """Start from the splats of a file or of another run, with all their values, to train them further.

    The run begins at the degree of their spherical harmonics. Coordinates of files are those of the data set.
    """

    file: Path | None = None
    """File of splats, or the folder of a finished run, whose point_cloud.ply is read."""

    axes: AxesOrAuto = "auto"
    """Axes of the numbers in the file, as SPZ names them: rdf for right, down, forward, those of a PLY file, which are
    taken as they are. auto: those that the file or its format names, else those that fit the photographs best."""

    def __post_init__(self) -> None:
        if self.file is not None:  # a run may be resumed from another working folder
            object.__setattr__(self, "file", self.file.resolve())

    def files(self) -> tuple[Path, ...]:
        """See `Start.files`."""
        return () if self.file is None else (model_file(self.file),)

    def refuse_unfit(self, primitive: Primitive, scene: Scene) -> None:
        """See `Start.refuse_unfit`."""
        path = existing_model(self.file, "start.file")
        table = read_sound(path)
        params = primitive.from_table(table.take(slice(0, 1)), torch.Generator().manual_seed(0))
        splats = primitive.activate(params, 0)
        what, name = f"{path}: its {table.kind}s", f"primitive:{name_of(primitive)}"
        flatter = table.log_scales.shape[1] == 3 and params["scales"].shape[1] == 2
        if splats.kind != table.kind or (flatter and not is_thin(table)):
            lost = " without their thinnest axis" if flatter else ""
            emit(Warned(f"{what} become {splats.kind}s{lost}, as the recipe has {name}; pictures will differ"))
        elif table.is_filtered:
            if not splats.antialias and splats.geometry == "axis":
                emit(Warned(untold_drawing(path, DRAWN_AS)))
        elif splats.antialias != table.antialias:
            flag = "--primitive.antialias" if table.antialias else "--primitive.no-antialias"
            emit(Warned(f"{what} were trained {'with' if table.antialias else 'without'} antialias; add {flag}"))
        if table.sh_degree > primitive.sh_degree:
            emit(
                Warned(
                    f"{what} have spherical harmonics of degree {table.sh_degree}, which are cut to "
                    f"{primitive.sh_degree}; --primitive.sh-degree {table.sh_degree} keeps them"
                )
            )

    def model(self, primitive: Primitive, known: StartInput, generator: torch.Generator) -> InitialModel:
        """See `Start.model`."""
        table = self._table(known.scene)
        warn_of_no_fit(existing_model(self.file, "start.file"), table, known.scene)
        return InitialModel(primitive.from_table(table, generator), min(table.sh_degree, primitive.sh_degree))

    def cloud(self, known: StartInput) -> SparsePoints:
        """See `Start.cloud`; only positions, colours, opacities and mean sizes."""
        return cloud_of(self._table(known.scene))

    @property
    def is_dense(self) -> bool:
        """See `Start.is_dense`."""
        return True

    def expected(self, sparse: int, pixels: int) -> int:
        """See `Start.expected`."""
        return len(read_sound(existing_model(self.file, "start.file")))

    def _table(self, scene: Scene) -> SplatTable:
        path = existing_model(self.file, "start.file")
        return read_in_scene(path, scene, self.axes, "--start.axes")


def is_thin(table: SplatTable) -> bool:
    """Whether most ellipsoids are flat: THIN times thinner along one axis than along the others."""
    ordered = table.log_scales.sort(1).values
    return bool((ordered[:, 1] - ordered[:, 0]).median() >= math.log(SURFEL_SCALE_RATIO))
