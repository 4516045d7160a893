"""`surfkit mesh`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.apps.run_summary import mesh_rows
from surfkit.cli.console_table import print_table
from surfkit.cli.recipes import ARGV, part_of_run
from surfkit.core.check import BadInput
from surfkit.core.lock import locked
from surfkit.core.registry import choice
from surfkit.mesh.base import Mesher
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.select import Device
from surfkit.runs.ensure_depth_maps import with_maps_to_mesh
from surfkit.runs.folder import Run
from surfkit.runs.journal import record_events
from surfkit.runs.make_mesh import make_mesh, mesh_input
from surfkit.runs.mesh_output import MeshOutput
from surfkit.runs.pipeline import loaded
from surfkit.runs.run_method import refuse_mesher
from surfkit.runs.run_notes import collect_notes
from surfkit.runs.warn import note_held_out
from surfkit.scene.available_memory import cache_bytes
from surfkit.train.data_cache import CacheSettings
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class MeshCommand:
    """Make the mesh of a finished run, or make it again with other settings; writes mesh.ply, mesh.json and pictures.

    Settings that are not given are those of the run's recipe. Example: `surfkit mesh RUN mesh:tsdf --mesh.voxel 0.5`.
    Small separate clusters of triangles are removed. Coordinates are those of the data set.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    mesh: Annotated[Mesher, choice(Mesher)] = field(default_factory=partial(part_of_run, "mesh", TSDF))
    """Method that makes triangles from splats; a mesh that the method of the run made itself is written again."""

    delivery: Annotated[MeshOutput, tyro.conf.arg(name="")] = MeshOutput()
    """What is written."""

    compressed: bool = False
    """Mesh the compressed model of the run instead (`surfkit compress`), into RUN/compressed."""

    memory: str = "auto"
    """Memory to use, such as 4GB; auto is half of the free memory. Larger meshes are made in tiles."""

    metres_per_unit: float | None = None
    """Metres per unit of the data set's coordinates, if the data set does not state it. Settings in metres need it."""

    device: Device = "auto"
    """Device for rendering and fusing: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    prepare: bool = True
    """Estimate the depth maps that the mesher needs, with the settings of the run's recipe, if there are none. They are
    kept in $SURFKIT_CACHE, or ~/.cache/surfkit."""

    prepare_cache: str = "20GB"
    """Disk space for these depth maps, of all data sets together; when they take more, the least recently used are
    deleted."""

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise BadInput(f"--metres-per-unit {self.metres_per_unit:g}: it must be more than 0")

        if any(word.startswith(("mesh:", "--mesh.")) for word in ARGV.get()):
            refuse_mesher(self.run_folder)

    def run(self) -> None:
        """Make the mesh, and print the results."""
        budget = cache_bytes(self.memory, "--memory")
        caches = CacheSettings(maps=self.prepare_cache if self.prepare else None)
        caches.maps_bytes()  # or BadInput, before anything is done
        self.mesh.ready()
        with collect_notes(), bars(), loaded(self.run_folder, self.device, self.compressed) as (ctx, made):
            run, scene = ctx.run, ctx.scene
            if self.metres_per_unit is not None:
                scene = replace(scene, frame=replace(scene.frame, metres=self.metres_per_unit))
            mesher = None if made.mesh is not None else self.mesh
            maps = nullcontext(run) if mesher is None else with_maps_to_mesh(run, mesher, scene, caches, self.device)
            subject = self.mesh if made.mesh is None else made.mesh
            with locked(run.out), full_disk_in_one_line(run.out), maps as run, record_events(run.out):
                what = mesh_input(run, made, scene, ctx.rasterizer, budget, mesher)
                record = make_mesh(run, subject, self.delivery, what, made.last_steps)
            note_held_out(run, scene)
        show(run, record)


def show(run: Run, record: dict[str, Any]) -> None:
    """Print what the mesh is, and the paths of what was written."""
    print_table(("mesh", "value"), mesh_rows(record))
    print()
    paths = [("mesh", run.out / name) for name in record["files"]] + [("facts", run.mesh_record)]
    paths += [("picture", path) for path in sorted(run.mesh_pictures.glob("*.png"))]
    print_table(("written", "path"), [(what, str(path)) for what, path in paths])


COMMAND = MeshCommand
