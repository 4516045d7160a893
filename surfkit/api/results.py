"""What comes of a run: triangles and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.fit import fit
from surfkit.evaluate.geometry.surface_file import metres_in, read_surface, system_of
from surfkit.mesh.base import VALUES
from surfkit.mesh.base import Mesh as LocalMesh
from surfkit.mesh.mesh_export import write_mesh
from surfkit.scene.scene import Frame


@dataclass(frozen=True)
class RunMesh:
    """Triangles in the frame of the input.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int32, counter-clockwise from outside.
        colors: (V, 3) uint8; None where the file is no PLY or has none.
        values: Of the vertices, by name: (V,) float32; see `surfkit.mesh.base.VALUES`. None of files that are no PLY.
        path: The file that it was read from.
        crs: Coordinate reference system of the vertices, such as "EPSG:32632"; None where the file does not say.
        metres: Metres per unit; None where the file does not say.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    values: Mapping[str, np.ndarray] = field(default_factory=dict)
    path: Path | None = None
    crs: str | None = None
    metres: float | None = None

    @staticmethod
    def read(path: Path) -> RunMesh:
        """The mesh in a file.

        Raises:
            BadInput: It has no faces, or cannot be read.
        """
        found = read_surface(path)
        if found.faces is None:
            raise BadInput(f"{path}: a cloud of points; name a mesh")
        names = found.rows.dtype.names or ()
        colors = [found.rows[name] for name in ("red", "green", "blue") if name in names]
        values = {name: np.asarray(found.rows[name]) for name in VALUES if name in names}
        color = np.stack(colors, 1) if colors else None
        return RunMesh(found.vertices(), found.faces, color, values, path, system_of(path), metres_in(path))

    def save(self, path: str | Path) -> Path:
        """Write it as .ply, .obj or .glb.

        Raises:
            BadInput: Another suffix, or no path.
        """
        file = fit(Path, path, "save")
        frame = replace(Frame.of_positions(self.vertices), crs=self.crs, metres=self.metres)
        frame = replace(frame, origin=np.array(frame.shift))  # float32 would round survey coordinates to half a metre
        local = LocalMesh(frame.to_local(self.vertices).astype(np.float32), self.faces, self.colors, dict(self.values))
        return write_mesh(file, local, frame)[0]


@dataclass(frozen=True)
class Figures:
    """What was measured.

    Attributes:
        metrics: As metrics.json has it.
    """

    metrics: Mapping[str, Any]

    @property
    def psnr(self) -> float:
        """Mean over the held-out photographs, dB."""
        return self._of("images", "psnr")

    @property
    def ssim(self) -> float:
        """Mean over the held-out photographs."""
        return self._of("images", "ssim")

    @property
    def precision(self) -> float:
        """Share of the mesh that lies within tau of the truth."""
        return self._of("geometry", "precision")

    @property
    def recall(self) -> float:
        """Share of the truth that lies within tau of the mesh."""
        return self._of("geometry", "recall")

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return self._of("geometry", "f1")

    def _of(self, *names: str) -> float:
        found: Any = self.metrics
        for name in names:
            found = found.get(name) if isinstance(found, Mapping) else None
        if found is None:
            raise BadInput(
                f"{names[-1]} was not measured; evaluate() measures held-out photographs, evaluate(gt=FILE) the mesh"
            )
        return float(found["mean"] if isinstance(found, Mapping) else found)
