"""What becomes of the triangles of a mesher: which part of them is kept, how few, how closed, in which files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.io.area import Area, bounds_of, read_area, require_area
from surfkit.io.polygon_file import Site
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.mesh_export import Format
from surfkit.mesh.simplify import require_kernels
from surfkit.scene.crop import Crop, box, read_crop
from surfkit.scene.up_direction import map_axes, up_direction


@dataclass(frozen=True)
class MeshOutput:
    """What becomes of the triangles of a mesher."""

    formats: tuple[Format, ...] = ("ply",)
    """Files to write: ply, obj, glb. GLB has 32-bit floats only, so its coordinates are relative to an offset, which is
    in NAME.glb.json."""

    lods: tuple[float, ...] = ()
    """Also write meshes with these shares of the triangles, such as 0.25 0.05: mesh-lod1, mesh-lod2 and so on."""

    triangles: int | None = None
    """Simplify the mesh to at most this many triangles; flat places get large ones. Parts and holes stay: where they
    need more, a line says so. With `--error`, it ends at whichever comes first."""

    error: float | None = None
    """Simplify the mesh until its surface would move by more than about this: metres, or units of the data set where it
    does not say how long these are. One place of a hundred may move farther."""

    watertight: bool = False
    """Close the mesh, for printing and simulation: each edge gets two triangles. Holes are filled; open ground gets
    walls and a flat base. Small loose sheets are left out, and so are small bodies, by `--clusters` and
    `--least-triangles`."""

    clusters: int = 50
    """Keep this many of the largest clusters of connected triangles, and drop the smaller ones."""

    least_triangles: int = 50
    """Also drop clusters of connected triangles with fewer triangles than this."""

    cluster_gap: float = 3.0
    """Clusters with a gap of about this many median edge lengths count as one: thin walls come in pieces. 0: only
    triangles that share vertices."""

    hole_edges: int = 0
    """Fill holes of up to this many edges; 0 leaves all open."""

    crop_box: tuple[float, float, float, float, float, float] | None = None
    """Keep only what lies in this box: lowest x y z, then highest x y z, in the frame of the input."""

    crop: Path | None = None
    """Keep only what lies in the volume of this crop file, JSON in the format of Tanks and Temples, in the frame of the
    input."""

    area: Path | None = None
    """Keep only what lies within the polygons of this file in plan, at any height: GeoJSON, GPKG or SHP, in any
    coordinate reference system."""

    def __post_init__(self) -> None:
        for name in ("clusters", "least_triangles"):
            if getattr(self, name) < 1:
                raise BadInput(f"--{name.replace('_', '-')} {getattr(self, name)}: give 1 or more")
        if not 0 <= self.cluster_gap <= 100:
            raise BadInput(f"--cluster-gap {self.cluster_gap:g}: give 0 to 100")
        if not 0 <= self.hole_edges <= 1000:
            raise BadInput(f"--hole-edges {self.hole_edges}: give 0 to 1000")
        if wrong := [share for share in self.lods if not 0 < share < 1]:
            raise BadInput(f"--lods {wrong[0]:g}: a share of the triangles lies between 0 and 1")
        if not self.formats:
            raise BadInput("--formats: name at least one of ply, obj, glb")
        if self.crop is not None and self.crop_box is not None:
            raise BadInput("--crop and --crop-box: give one of the two")
        if self.triangles is not None and self.triangles < 4:
            raise BadInput(f"--triangles {self.triangles}: give 4 or more")
        if self.error is not None and not 0 < self.error < float("inf"):
            raise BadInput(f"--error {self.error:g}: it must be more than 0")
        if self.area is not None:
            require_area()
        for name in ("lods", "triangles", "error", "watertight"):
            if getattr(self, name):
                require_kernels(f"--{name}")

    def volume(self) -> Crop | None:
        """The crop, in the frame of the input."""
        if self.crop_box is not None:
            return box(self.crop_box)
        return None if self.crop is None else read_crop(self.crop)

    def area_of(self, subject: MeshInput, maker: Mesher | Mesh) -> Area | None:
        """The area; BadInput, before a mesh is made, if it lies beside all cameras and all that is meshed.

        Args:
            subject: What is meshed.
            maker: How; or the mesh, where it is there.
        """
        if self.area is None:
            return None
        frame, axes = subject.frame, map_axes(up_direction(None, subject.views, subject.frame, np.eye(4)).direction)
        places = maker.vertices if isinstance(maker, Mesh) else subject.splats.means.detach().cpu().numpy()
        centres = np.array([view.camera.centre.numpy() for view in subject.views]).reshape(-1, 3)
        bounds = bounds_of((frame.to_input(each) for each in (places, centres)), axes)
        return read_area(self.area, Site("the scene", frame.crs, bounds), axes)
