"""The scans of DTU as the truth of a table: the chamfer distance of each mesh, as that benchmark has it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.dtu import (
    FAR_MM,
    cut,
    dtu_distances,
    in_silhouettes,
    read_observability,
    read_plane,
    read_scale,
    sampled,
)
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.evaluate.geometry.transform import apply
from surfkit.evaluate.mesh.measure_mesh import measure_mesh
from surfkit.io.datasets.masks import read_mask
from surfkit.scene.photo_names import PICTURE_SUFFIXES
from surfkit.scene.photos import photo_size
from surfkit.scene.scene import Scene
from surfkit.study.truth import Truth


@dataclass(frozen=True)
class DTUTruth(Truth):
    """A scan of DTU; `path` is its cloud of structured light.

    Attributes:
        observability: Where the scanner saw, see `read_observability`.
        plane: Of the table, see `read_plane`.
        scale: From the frame of the cameras to millimetres, see `read_scale`.
        masks: Folder of silhouettes, one for each photograph, in the order of the names of both.
    """

    figure: ClassVar[str] = "chamfer"

    observability: Path = Path()
    plane: Path = Path()
    scale: Path = Path()
    masks: Path = Path()

    def refuse_unusable(self) -> None:
        """See `Truth.refuse_unusable`."""
        if read_surface(self.path).faces is not None:
            raise BadInput(f"{self.path}: a mesh; the scan must be a cloud of points")
        read_observability(self.observability)
        read_plane(self.plane)
        read_scale(self.scale)

    @property
    def record(self) -> dict[str, Any]:
        return {"tau": None, "protocol": "dtu"}

    def silhouettes(self, count: int) -> list[np.ndarray]:
        """(h, w) bool of each of `count` photographs.

        Raises:
            BadInput: Not as many masks as photographs.
        """
        paths = sorted(path for path in self.masks.glob("*") if path.suffix.lower() in PICTURE_SUFFIXES)
        if len(paths) != count:
            raise BadInput(f"{self.masks}: {len(paths)} masks for {count} photographs; there must be one for each")
        return [read_mask(path, photo_size(path)).numpy() for path in paths]

    def compare(self, mesh: Path, folder: Path, scene: Scene) -> dict[str, Any]:
        """See `Truth.compare`; nothing is written, as there is no crop volume."""
        surface = read_surface(mesh)
        if surface.faces is None:
            raise BadInput(f"{mesh}: a cloud of points, not a mesh")
        views = sorted([*scene.train, *scene.held_out], key=lambda view: view.name)
        kept = in_silhouettes(surface.vertices(), views, scene.frame, self.silhouettes(len(views)))
        left = cut(surface, kept)
        in_mm = SurfaceFile(mesh, apply(read_scale(self.scale), left.vertices()), left.faces)
        points, scan = sampled(in_mm, np.random.default_rng(0)), read_surface(self.path).vertices()
        found, counted = dtu_distances(points, scan, read_observability(self.observability), read_plane(self.plane))
        if None in found.values():
            raise BadInput(f"{mesh}: no part of it is within {FAR_MM:g} mm of {self.path}; are both in one frame?")
        geometry = {
            "truth": str(self.path),
            "reconstruction": str(mesh),
            "table": {**self.record, "truth": self.stamp},
            "chamfer_dtu": {**found, "far": FAR_MM},
            "points": {"reconstruction": len(counted.to_truth), "truth": len(counted.to_reconstruction)},
        }
        return {"geometry": geometry, "mesh": measure_mesh(surface, scene.frame.metres).figures}
