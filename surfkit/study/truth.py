"""F1 of the meshes of an ablation table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.evaluate.geometry.comparison import Comparison, truth_side
from surfkit.evaluate.geometry.measure_geometry import measure_geometry
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.raster.select import Device
from surfkit.runs.folder import Run, note_metrics
from surfkit.runs.measure_run import note_compressed
from surfkit.runs.pipeline import loaded, mesh, opened
from surfkit.runs.resume import read_unchanged
from surfkit.scene.scene import Scene

PLAIN = Comparison(classes=False)
"""How the rows of an ablation table are compared."""


@dataclass(frozen=True)
class Truth:
    """What meshes are compared with.

    Attributes:
        path: A mesh, or a cloud of points.
        tau: Distance below which a point counts as right; None for what the spacing of a cloud gives.
        comparison: How they are compared, but for tau.
    """

    figure: ClassVar[str] = "f1"
    """Name of the number that a mesh has once it is compared."""

    path: Path
    tau: float | None = None
    comparison: Comparison = PLAIN

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", self.path.resolve())
        self.settings  # noqa: B018 (refuses a threshold of no length)

    @property
    def settings(self) -> Comparison:
        """How meshes are compared."""
        return replace(self.comparison, tau=self.tau)

    def refuse_unusable(self) -> None:
        """BadInput for a file that no mesh could be compared with."""
        truth_side(read_surface(self.path), self.settings)

    @property
    def stamp(self) -> str | None:
        """Size and time of the file, by which another one of the same name is noticed; None if it is gone."""
        try:
            state = self.path.stat()
        except OSError:
            return None
        return f"{state.st_size} {state.st_mtime_ns}"

    def known(self, metrics: Mapping[str, Any], compressed: bool = False) -> bool:
        """Whether the metrics of a run have the F1 of its mesh, or of that of its compressed model, against this.

        What `surfkit evaluate` has measured with other settings, or in another volume, is not that.
        """
        own = metrics.get("compressed") or {} if compressed else metrics
        geometry = own.get("geometry") or {}
        made = geometry.get("table")
        if not isinstance(made, dict) or self.stamp not in (None, made.get("truth")):
            return False
        is_same = {name: it for name, it in made.items() if name != "truth"} == self.record
        return geometry.get("truth") == str(self.path) and is_same and "mesh" in own  # older versions have none

    @property
    def record(self) -> dict[str, Any]:
        """Plain data by which figures that were measured otherwise are noticed."""
        other = {} if self.comparison == PLAIN else {"comparison": dump(self.comparison)}
        # What has no "shares_crop" was measured in the volume of the row before it, which may end above a false ground.
        return {"tau": self.tau, **other, "shares_crop": False}

    def measure(self, folder: Path, device: Device = "auto") -> dict[str, Any]:
        """Compare the mesh of a run, and return its metrics with what came out.

        Where the recipe compresses the model, it is the mesh of the compressed model, which is made here.

        Args:
            folder: Of the run.
            device: For the depth of the compressed model.

        Raises:
            BadInput: There is no mesh, or it is nowhere near the truth.
        """
        run = opened(folder)
        shown = run if run.recipe.compress is None else mesh_of_compressed(run, device)
        if not shown.mesh_record.exists():
            raise BadInput(f"{shown.out}: no mesh that could be compared with {self.path}")
        found = self.compare(shown.mesh, shown.out / "geometry", read_unchanged(run))
        metrics = note_metrics(shown.metrics, found)
        return metrics if shown is run else note_compressed(run, metrics)

    def compare(self, mesh: Path, folder: Path, scene: Scene) -> dict[str, Any]:
        """What metrics.json is to say of a mesh in the frame of a scene, against this.

        The volume that the views give is the same for all meshes in plan, and as high as each: what comes out does not
        depend on what was measured before, and a false ground below that of the other rows counts.

        Args:
            mesh: The file.
            folder: Gets pictures and clouds.
            scene: Whose views decide the volume.

        Raises:
            BadInput: The mesh is nowhere near the truth.
        """
        found = measure_geometry((mesh, self.path), self.settings, folder, scene.train, scene.frame)
        found["geometry"]["table"] = {**self.record, "truth": self.stamp}
        return found


def mesh_of_compressed(run: Run, device: Device) -> Run:
    """The folder of the compressed model of a run, with its mesh; made by the mesher of the recipe if it is not there.

    Raises:
        BadInput: There is no compressed model.
    """
    shown = replace(run, out=run.compressed)
    if not shown.mesh_record.exists():
        with loaded(run.out, device, compressed=True) as (ctx, made):
            mesh(ctx, made, device)
    return shown
