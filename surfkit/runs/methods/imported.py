"""Splats from a file, as they are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.models import existing_model, model_file, read_sound, warn_of_no_fit
from surfkit.io.splats.splat_files import untold_drawing
from surfkit.primitives.model import DrawnAs, SplatModel, primitive_of
from surfkit.runs.methods.base import Method, MethodInput, Reconstruction
from surfkit.start.guess_axes import read_in_scene


@dataclass(frozen=True)
class SplatImport(Method):
    """Take the splats of a file as they are, to measure, mesh or compress them; nothing is optimised.

    Coordinates of files are those of the data set.
    """

    uses: ClassVar[tuple[str, ...]] = ("depth", "compress", "mesh", "lod")

    file: Path | None = None
    """File of splats, or the folder of a finished run, whose point_cloud.ply is read."""

    axes: AxesOrAuto = "auto"
    """Axes of the numbers in the file, as SPZ names them: rdf for right, down, forward, those of a PLY file, which are
    taken as they are. auto: those that the file or its format names, else those that fit the photographs best."""

    drawn_as: DrawnAs = "auto"
    """How the program that trained ellipsoids draws them. 3dgs: with the blur of 3DGS; antialias: with it made up for,
    as gsplat does in its mode antialiased; mip-splatting: likewise with its smaller blur; gof: along rays without blur
    (Gaussian Opacity Fields). auto: as the file says, and as 3DGS where it says nothing."""

    def __post_init__(self) -> None:
        if self.file is not None:  # a run may be resumed from another working folder
            object.__setattr__(self, "file", self.file.resolve())

    def files(self) -> tuple[Path, ...]:
        """See `Method.files`."""
        return () if self.file is None else (model_file(self.file),)

    def refuse_unfit(self, given: MethodInput) -> None:
        """See `Method.refuse_unfit`."""
        if given.folder.exists():
            return  # begun: the run has its own copy, or reads the file now
        table = read_sound(existing_model(self.file, "method.file"))
        if table.kind == "surfel" and self.drawn_as != "auto":
            raise BadInput(
                f"{self.file}: its splats are discs, and drawn-as {self.drawn_as} is for ellipsoids; leave it out"
            )

    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """See `Method.reconstruct`."""
        path = existing_model(self.file, "method.file")
        table = read_in_scene(path, given.scene, self.axes)
        warn_of_no_fit(path, table, given.scene)
        if table.is_filtered and self.drawn_as == "auto":
            emit(Warned(untold_drawing(path)))
        primitive = primitive_of(table, self.drawn_as)
        params = primitive.from_table(table, given.generator)
        return Reconstruction(
            splats=SplatModel(primitive, params, table.sh_degree),
            facts={"file": str(path), "kind": table.kind, "sh_degree": table.sh_degree, "axes": table.axes.name},
        )
