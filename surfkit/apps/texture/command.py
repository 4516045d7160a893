"""`surfkit texture`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.apps.texture.texture_mesh import TEXTURE_RECORD, MeshWithPhotos, TextureSettings, make_texture
from surfkit.cli.console_table import print_table
from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import read_mesh
from surfkit.io.usdz import require_usd
from surfkit.mesh.simplify import require_simplification
from surfkit.runs.command import refuse_no_mesh
from surfkit.runs.pipeline import opened
from surfkit.runs.resume import read_unchanged
from surfkit.runs.run_notes import collect_notes
from surfkit.runs.warn import note_held_out
from surfkit.scene.available_memory import cache_bytes
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class TextureCommand:
    """Give the mesh of a finished run a texture from the photographs; writes OBJ, GLB and 3D Tiles, or OpenUSD, into
    RUN/texture.

    Each triangle takes its picture from one photograph that shows it whole, well, and in the colour that others show
    too; seams between photographs are levelled. The mesh is simplified first, which needs `pip install
    'surfkit[texture]'`. Examples: `surfkit texture RUN`, `surfkit texture RUN --formats glb --triangles 100000`.
    When it is interrupted, the same command goes on where it stopped.
    """

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    out: Path | None = None
    """Folder for the textured mesh; by default RUN/texture."""

    settings: Annotated[TextureSettings, tyro.conf.arg(name="")] = TextureSettings()
    """What is written."""

    memory: str = "auto"
    """Memory for photographs, such as 4GB; auto is half of the free memory. The mesh comes on top of it."""

    metres_per_unit: float | None = None
    """Metres per unit of the data set's coordinates, if the data set does not state it."""

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise BadInput(f"--metres-per-unit {self.metres_per_unit:g}: it must be more than 0")
        kind = self.out.suffix.lower().removeprefix(".") if self.out is not None else ""
        if kind in ("obj", "glb", "json", "usdz"):
            made = "tiles3d" if kind == "json" else kind
            raise BadInput(f"--out {self.out}: give a folder, and --formats {made}")

    def run(self) -> None:
        """Make the textured mesh, and print what it is."""
        require_simplification("simplifying a mesh")
        if "usdz" in self.settings.formats:
            require_usd("--formats usdz")
        budget = cache_bytes(self.memory, "--memory")
        run = opened(self.run_folder)
        refuse_no_mesh(run)
        out = self.out or run.out / "texture"
        with collect_notes(), bars(), full_disk_in_one_line(out):
            scene = read_unchanged(run)
            frame = scene.frame
            if self.metres_per_unit is not None:
                frame = replace(frame, metres=self.metres_per_unit)
            record = make_texture(MeshWithPhotos(read_mesh(run.mesh), frame, scene.train), self.settings, out, budget)
            note_held_out(run, scene)
        show(out, record)


def show(out: Path, record: dict[str, Any]) -> None:
    """Print what the textured mesh is, and the paths of what was written."""
    unit = record["unit"]
    pages = ", ".join(f"{width} x {height}" for width, height in record["pages"][:4])
    rows = [
        ("texel", f"{record['texel']:g} {unit}"),
        ("triangles", f"{record['triangles']:,}"),
        ("surface that photographs show", f"{record['seen']:.1%}"),
        ("photographs used", f"{record['photographs']:,}"),
        ("gains of photographs, of linear light", "{:.3f} to {:.3f}".format(*record["gains"])),
        ("light in their corners, of the middle", "{:.3f} to {:.3f}".format(*record["corners"])),
        ("charts", f"{record['charts']:,}"),
        ("pages", f"{len(record['pages'])}: {pages}{' ...' if len(record['pages']) > 4 else ''}"),
        ("tiles", f"{record['tiles']:,}"),
    ]
    print_table(("textured mesh", "value"), rows)
    print()
    print_table(("written",), [(str(out / name),) for name in (*record["files"], TEXTURE_RECORD)])


COMMAND = TextureCommand
