"""Splats from a file, as they are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.models import existing_model, model_file, read_sound, warn_of_no_fit
from surfkit.primitives.model import SplatModel, primitive_of
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
        read_sound(existing_model(self.file, "method.file"))

    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """See `Method.reconstruct`."""
        path = existing_model(self.file, "method.file")
        table = read_in_scene(path, given.scene, self.axes)
        warn_of_no_fit(path, table, given.scene)
        primitive = primitive_of(table)
        params = primitive.from_table(table, given.generator)
        return Reconstruction(
            splats=SplatModel(primitive, params, table.sh_degree),
            facts={"file": str(path), "kind": table.kind, "sh_degree": table.sh_degree, "axes": table.axes.name},
        )
