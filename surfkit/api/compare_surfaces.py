"""Any two surfaces in Python: a mesh or a cloud of another program, or points in memory, against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from surfkit.api.dataset import Dataset
from surfkit.api.listen import heard
from surfkit.api.results import Figures, RunMesh
from surfkit.core.check import BadInput, expect
from surfkit.core.fit import fit, settings_of
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.evaluate.geometry.measure_geometry import measure_geometry
from surfkit.io.splats.ply import write_points
from surfkit.train.faults import full_disk_in_one_line
from surfkit.train.progress_bars import bars

Surface = str | Path | np.ndarray | RunMesh
"""A file; (P, 3) points, or a mesh, frame of the input."""


def compare(
    reconstruction: Surface, truth: Surface, out: str | Path, scene: Dataset | None = None, **settings: Any
) -> Figures:
    """Precision, recall and F1 of any mesh or cloud against the truth, as `surfkit evaluate FILE --gt TRUTH`.

    Args:
        reconstruction: What is measured: a file, (P, 3) points, or a mesh.
        truth: A file (cloud, mesh, raster of heights), (P, 3) points, or a mesh, in the same coordinates.
        out: Folder for pictures, clouds coloured by error, and the arrays as files.
        scene: Its training views say where is compared; without it, give `crop="none"` or a file.
        settings: Of the comparison, `tau=0.5`, `align="none"`; see `Comparison`.

    Raises:
        BadInput: A file or array that cannot be used, or two that do not belong together.
    """
    folder, comparison = fit(Path, out, "compare: out"), settings_of(Comparison, settings, "compare")
    given = {"reconstruction": reconstruction, "truth": truth}
    ours, theirs = (surface_file(surface, folder, name) for name, surface in given.items())
    views, frame = ((), None) if scene is None else (scene.train, scene.frame)
    with heard(), bars(), full_disk_in_one_line(folder):
        return Figures(measure_geometry((ours, theirs), comparison, folder, views, frame))


def surface_file(surface: Any, folder: Path, name: str) -> Path:
    """The file of a surface; what is in memory is written to `folder`.

    Raises:
        BadInput: Neither a file, nor a mesh, nor finite points.
    """
    if isinstance(surface, RunMesh):
        folder.mkdir(parents=True, exist_ok=True)
        return surface.save(folder / f"{name}.ply")
    if not isinstance(surface, np.ndarray):
        return fit(Path, surface, name)
    expect(name, surface, ("P", 3))
    if not np.isfinite(surface).all():
        raise BadInput(f"{name}: has NaN or Inf; give finite positions")
    folder.mkdir(parents=True, exist_ok=True)
    write_points(folder / f"{name}.ply", surface, np.full(surface.shape, 128, np.uint8))
    return folder / f"{name}.ply"
