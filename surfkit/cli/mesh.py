"""`surfkit mesh`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.cli.recipes import ARGV
from surfkit.cli.table import print_table
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.core.lock import locked
from surfkit.core.registry import choice
from surfkit.mesh.base import Mesher
from surfkit.mesh.tsdf import TSDF
from surfkit.pipeline import load_run
from surfkit.raster.select import Device
from surfkit.recipe import Recipe
from surfkit.run.folder import Run
from surfkit.run.journal import record_events
from surfkit.run.mesh import MeshOutput, make_mesh, mesh_input
from surfkit.run.notes import collect_notes
from surfkit.run.prepare import with_maps_to_mesh
from surfkit.run.stage import select_rasterizer
from surfkit.scene.memory import cache_bytes
from surfkit.train.bars import bars
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.material import CacheSettings


def named_mesher() -> Mesher:
    """That of the recipe of the run which is being named; the usual one if it has none."""
    for word in ARGV.get():
        path = Path(word) / "recipe.json"
        if not word.startswith("-") and path.is_file():
            return read_json(path, Recipe).mesh or TSDF()
    return TSDF()


@dataclass(frozen=True)
class MeshOf:
    """Make the mesh of a finished run, or make it again with other settings; writes mesh.ply, mesh.json and pictures.

    Settings are those of the run's recipe where nothing else is said: `surfkit mesh RUN mesh:tsdf --mesh.voxel 0.5`.
    Small loose clusters are dropped. Coordinates are those of the data set.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    mesh: Annotated[Mesher, choice(Mesher)] = field(default_factory=named_mesher)
    """How the splats become triangles."""

    delivery: Annotated[MeshOutput, tyro.conf.arg(name="")] = MeshOutput()
    """What is written."""

    memory: str = "auto"
    """Memory to use, such as 4GB; auto takes half of what is free. Work is done in tiles where it would take more."""

    metres_per_unit: float | None = None
    """Metres in a unit of the data set's coordinates, where it does not say. Settings in metres need it."""

    device: Device = "auto"
    """Where to compute."""

    prepare: bool = True
    """Make the depth maps that the mesher wants as the recipe of the run says, where there are none; they are kept in
    $SURFKIT_CACHE, or ~/.cache/surfkit."""

    prepare_cache: str = "20GB"
    """Disk for such depth maps, of all data sets together; those longest unused are deleted when there are more."""

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise BadInput(f"--metres-per-unit {self.metres_per_unit:g}: it must be more than 0")

    def run(self) -> None:
        """Mesh, and show what came out."""
        budget = cache_bytes(self.memory, "--memory")
        caches = CacheSettings(maps=self.prepare_cache if self.prepare else None)
        caches.maps_bytes()  # or BadInput, before anything is done
        self.mesh.ready()
        with collect_notes(), bars():
            run, state, scene = load_run(self.run_folder)
            if self.metres_per_unit is not None:
                scene = replace(scene, frame=replace(scene.frame, metres=self.metres_per_unit))
            rasterizer, _ = select_rasterizer(self.device)
            with (
                locked(run.out),
                full_disk_in_one_line(run.out),
                with_maps_to_mesh(run, self.mesh, scene, caches, self.device) as run,
                record_events(run.out),
            ):
                what = mesh_input(run, state, scene, rasterizer, budget, self.mesh)
                record = make_mesh(run, self.mesh, self.delivery, what, state.index)
        show(run, record)


def show(run: Run, record: dict[str, Any]) -> None:
    """Print what the mesh is, and the paths of what was written."""
    cleaning, lengths = record["cleaning"], record["lengths"]
    rows = [
        ("triangles", f"{cleaning['triangles']:,}"),
        ("vertices", f"{cleaning['vertices']:,}"),
        ("clusters kept", f"{cleaning['clusters_kept']:,} of {cleaning['clusters']:,}"),
        ("boundaries", f"{cleaning['boundaries']:,}, {cleaning['boundary_share']:.1%} of all edges"),
        *([("holes filled", f"{cleaning['holes_closed']:,}")] if cleaning["holes_closed"] else []),
        *((name.replace("_", " "), f"{value:.6g}") for name, value in lengths.items()),
        ("seconds", f"{record['seconds']:.1f}"),
    ]
    print_table(("mesh", "value"), rows)
    print()
    paths = [("mesh", run.out / name) for name in record["files"]] + [("facts", run.mesh_record)]
    paths += [("picture", path) for path in sorted(run.mesh_pictures.glob("*.png"))]
    print_table(("written", "path"), [(what, str(path)) for what, path in paths])


COMMAND = MeshOf
