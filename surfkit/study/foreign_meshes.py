"""Meshes that other programs have made of the same photographs, as rows of an ablation table."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json
from surfkit.core.version import own_version
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.runs.folder import note_metrics
from surfkit.study.ablation import Row, Table
from surfkit.study.row_comparison import compared, surface_figures
from surfkit.study.rows import TrialResult
from surfkit.study.truth import Truth
from surfkit.train.progress_bars import bars

if TYPE_CHECKING:
    from surfkit.study.study import AblationPlan

MESHES_FOLDER = "meshes"
"""In that of a table: what was measured of meshes of other programs."""
GROUP = "Other programs"
"""Heading of the part of a table that has them."""


@dataclass(frozen=True)
class OtherMesh:
    """A mesh in the frame of the photographs.

    Attributes:
        label: Its name in the table: the program, with its version.
        path: A file that `surfkit evaluate` takes.
    """

    label: str
    path: Path

    @classmethod
    def parsed(cls, word: str) -> OtherMesh:
        """Of LABEL=FILE.

        Raises:
            BadInput: It is not that.
        """
        label, sign, path = word.partition("=")
        if not sign or not label.strip() or not path:
            raise BadInput(f"--meshes {word}: give LABEL=FILE, such as OpenMVS=scene_mesh.ply")
        return cls(label.strip(), Path(path))

    def refuse_unusable(self) -> None:
        """BadInput for what is no mesh."""
        if read_surface(self.path).faces is None:
            raise BadInput(f"--meshes {self.label}: {self.path} is a cloud of points; name a mesh")

    def folder(self, truth: Truth, data: Data, out: Path) -> Path:
        """Where its measurements are kept; of another file, truth or data set, or by another version, they lie
        elsewhere."""
        state = self.path.stat()
        parts = {
            "mesh": [str(self.path.resolve()), state.st_size, state.st_mtime_ns],
            "truth": [str(truth.path), truth.stamp, truth.record],
            "data": dump(replace(data, path=data.path.resolve())),  # whose views decide the volume, and the unit
            "version": own_version(),
        }
        return out / MESHES_FOLDER / hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]

    def measure(self, truth: Truth, data: Data, out: Path) -> None:
        """Compare it with the truth as the meshes of all rows are, and keep what came out.

        Raises:
            BadInput: It is nowhere near the truth, or one of the two cannot be used.
        """
        folder = self.folder(truth, data, out)
        note_metrics(folder / "metrics.json", truth.compare(self.path, folder / "geometry", read(data)))

    def figures(self, truth: Truth, data: Data, out: Path) -> dict[str, float] | None:
        """Its numbers, by the names of columns; None before it was measured."""
        path = self.folder(truth, data, out) / "metrics.json"
        if not path.exists():
            return None
        metrics = read_json(path, dict[str, Any])
        found = surface_figures(metrics.get("geometry") or {}, metrics.get("mesh") or {})
        return {name: float(value) for name, value in found.items() if value is not None}


def measured_mesh(mesh: OtherMesh, truth: Truth, data: Data, out: Path) -> TrialResult:
    """The numbers of a mesh, which is measured if it was not yet, or why it could not be."""
    try:
        if mesh.figures(truth, data, out) is None:
            with bars():
                mesh.measure(truth, data, out)
        return TrialResult(mesh.figures(truth, data, out))
    except BadInput as error:
        return TrialResult(failed=" ".join(str(error).split()))


def refuse_unfit(meshes: Sequence[OtherMesh], table: Table, data_sets: int, has_truth: bool) -> None:
    """BadInput for meshes that cannot be rows of a table: without a truth, of several data sets, or named twice."""
    if meshes and not has_truth:
        raise BadInput("--meshes: they are compared with the truth; name it with --gt")
    if meshes and data_sets != 1:
        raise BadInput(f"--meshes: they are of one data set, and --data names {data_sets}; give a command for each")
    taken = [row.label for row in table.rows]
    for mesh in meshes:
        if mesh.label in taken:
            raise BadInput(f"--meshes {mesh.label}: table:{table.name} has such a row already; choose another label")
        if not mesh.path.is_file():
            raise BadInput(f"--meshes {mesh.label}: {mesh.path}: no such file; name a mesh")
        taken.append(mesh.label)


def mesh_rows(
    plan: AblationPlan, place: tuple[Data, Truth], outcomes: Mapping[Path, TrialResult]
) -> list[dict[str, Any]]:
    """Plain data of the rows of meshes, as those of a table are.

    Args:
        plan: Of the table, whose own rows stand above.
        place: The photographs that they are of, and what they are compared with.
        outcomes: Of those that were measured now, by their folders.
    """
    rows, (data, truth) = [], place
    before, out = len(plan.table.rows), plan.out
    for at, mesh in enumerate(plan.meshes):
        found = mesh.figures(truth, data, out)
        row = Row(mesh.label, group="" if at else GROUP)
        folder = mesh.folder(truth, data, out)
        rows.append(
            compared(before + at + 1, row, None, {} if found is None else {mesh.label: {0: found}})
            | {
                "runs": []
                if found is None
                else [{"seed": None, "folder": folder.relative_to(out).as_posix(), **found}],
                "failed": outcomes.get(folder, TrialResult()).failed,
                "not_as_named": None,
                "file": str(mesh.path),
            }
        )
    return rows
