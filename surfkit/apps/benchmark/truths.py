"""Which files a scene is measured with, and how they become what meshes are compared with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.comparison import Comparison
from surfkit.evaluate.geometry.trajectory import onto_trajectory, read_log
from surfkit.evaluate.geometry.transform import read_transform, write_transform
from surfkit.scene.crop import read_crop
from surfkit.scene.scene import Scene
from surfkit.study.dtu_truth import DTUTruth
from surfkit.study.truth import PLAIN, Truth

Count = tuple[int, int | None]
"""Least and greatest number; None for no limit."""


@dataclass(frozen=True)
class Needed:
    """A file or folder that a benchmark needs.

    Attributes:
        path: Below the root.
        what: In words.
        source: Key of where it comes from, in the protocol.
        pictures: Number of pictures in a folder; None for a file.
        longest: Pixels that the longer side of each picture has at least.
        points: Number of points of a cloud, or of vertices of a mesh.
        faces: Number of faces of a mesh.
    """

    path: str
    what: str
    source: str
    pictures: Count | None = None
    longest: int | None = None
    points: Count | None = None
    faces: Count | None = None


class TruthFiles(ABC):
    """The truth of a scene as it is handed out."""

    @abstractmethod
    def needed(self) -> tuple[Needed, ...]:
        """The files."""

    @abstractmethod
    def truth(self, root: Path, out: Path, scene: Scene) -> Truth:
        """What meshes are compared with.

        Args:
            root: Folder of the benchmark.
            out: Of the results of the scene, for what is computed once.
            scene: Of the photographs.

        Raises:
            BadInput: A file that cannot be used, or does not belong to the photographs.
        """

    @abstractmethod
    def check(self, root: Path) -> None:
        """BadInput for a small file that cannot be read; the cloud or mesh is looked at by what `needed` says of it."""

    @abstractmethod
    def words(self) -> str:
        """How meshes are compared with it, in one line."""


@dataclass(frozen=True)
class SurfaceTruth(TruthFiles):
    """A cloud or a mesh in the frame of the photographs, but for its unit.

    Attributes:
        file: What is needed.
        comparison: How.
        tau: Threshold, units of the truth; None for what the spacing of the cloud gives.
        per_unit: Units of the truth for each unit of the photographs.
    """

    file: Needed
    comparison: Comparison = PLAIN
    tau: float | None = None
    per_unit: float = 1.0

    def needed(self) -> tuple[Needed, ...]:
        """See `TruthFiles.needed`."""
        return (self.file,)

    def truth(self, root: Path, out: Path, scene: Scene) -> Truth:
        """See `TruthFiles.truth`."""
        comparison = self.comparison
        if self.per_unit != 1:
            out.mkdir(parents=True, exist_ok=True)
            write_transform(out / "transform.txt", np.diag([self.per_unit] * 3 + [1.0]))
            comparison = replace(comparison, transform=(out / "transform.txt").resolve())
        return Truth(root / self.file.path, self.tau, comparison)

    def check(self, root: Path) -> None:
        """See `TruthFiles.check`."""

    def words(self) -> str:
        """See `TruthFiles.words`."""
        tau = "1.5 x the spacing of the thinned truth" if self.tau is None else f"{self.tau:g}"
        preset = f", preset {self.comparison.preset}" if self.comparison.preset else ""
        crop = "what enough training views see" if self.comparison.crop == "auto" else self.comparison.crop
        return (
            f"tau {tau}, alignment {self.comparison.align}, crop: {crop}{preset}, {self.comparison.draws} draws, "
            f"seed {self.comparison.seed}; {self.per_unit:g} units of the truth per unit"
        )


@dataclass(frozen=True)
class TanksTruth(TruthFiles):
    """A laser scan of Tanks and Temples: cloud, crop volume, cameras of the benchmark, and their transform.

    Attributes:
        scene: Name of the scene in names of files.
        folder: Of its files, below the root.
        tau: Threshold, metres.
        photographs: Number of cameras.
    """

    scene: str
    folder: str
    tau: float
    photographs: int

    def needed(self) -> tuple[Needed, ...]:
        """See `TruthFiles.needed`."""
        return (
            Needed(self._name(".ply"), "laser scan", "truth", points=(1_000_000, None)),
            Needed(self._name(".json"), "crop volume", "truth"),
            Needed(self._name("_trans.txt"), "transform from the cameras of the benchmark to the scan", "truth"),
            Needed(self._name("_COLMAP_SfM.log"), "cameras of the benchmark", "truth"),
        )

    def _name(self, end: str) -> str:
        return f"{self.folder}/{self.scene}{end}"

    def truth(self, root: Path, out: Path, scene: Scene) -> Truth:
        """See `TruthFiles.truth`."""
        views = sorted([*scene.train, *scene.held_out], key=lambda view: view.name)
        centres = scene.frame.to_input(np.array([view.camera.centre.tolist() for view in views]))
        log = root / self._name("_COLMAP_SfM.log")
        try:
            onto = onto_trajectory(centres, read_log(log))
        except BadInput as error:
            raise BadInput(f"{log}: {error}") from error
        out.mkdir(parents=True, exist_ok=True)
        write_transform(out / "transform.txt", read_transform(root / self._name("_trans.txt")) @ onto)
        comparison = replace(
            PLAIN, transform=(out / "transform.txt").resolve(), crop=str((root / self._name(".json")).resolve())
        )
        return Truth(root / self._name(".ply"), self.tau, comparison)

    def check(self, root: Path) -> None:
        """See `TruthFiles.check`."""
        read_crop(root / self._name(".json"))
        read_transform(root / self._name("_trans.txt"))
        found = len(read_log(root / self._name("_COLMAP_SfM.log")))
        if found != self.photographs:
            raise BadInput(f"{root / self._name('_COLMAP_SfM.log')}: {found} cameras; it must have {self.photographs}")

    def words(self) -> str:
        """See `TruthFiles.words`."""
        return (
            f"tau {self.tau:g} m, crop volume of the benchmark, alignment by the cameras, then similarity by ICP, "
            f"{PLAIN.draws} draws, seed {PLAIN.seed}"
        )


@dataclass(frozen=True)
class DTUTruthFiles(TruthFiles):
    """A scan of DTU.

    Attributes:
        number: Of the scan.
        photographs: And silhouettes.
    """

    number: int
    photographs: int

    @property
    def _official(self) -> str:
        return "SampleSet/MVS Data"

    def needed(self) -> tuple[Needed, ...]:
        """See `TruthFiles.needed`."""
        n = self.number
        masks = (self.photographs, self.photographs)
        return (
            Needed(f"scan{n}/mask", "silhouettes, one for each photograph", "photographs", pictures=masks),
            Needed(f"scan{n}/cameras.npz", "transform from the cameras to millimetres (scale_mat_0)", "photographs"),
            Needed(f"Points/stl/stl{n:03d}_total.ply", "structured light scan", "points", points=(100_000, None)),
            Needed(f"{self._official}/ObsMask/ObsMask{n}_10.mat", "observability mask", "sample"),
            Needed(f"{self._official}/ObsMask/Plane{n}.mat", "plane of the table", "sample"),
        )

    def truth(self, root: Path, out: Path, scene: Scene) -> Truth:
        """See `TruthFiles.truth`."""
        masks, scale, scan, seen, plane = (root / each.path for each in self.needed())
        found = DTUTruth(scan, observability=seen, plane=plane, scale=scale, masks=masks)
        found.silhouettes(len(scene.train) + len(scene.held_out))
        return found

    def check(self, root: Path) -> None:
        """See `TruthFiles.check`."""
        masks, scale, scan, seen, plane = (root / each.path for each in self.needed())
        DTUTruth(scan, observability=seen, plane=plane, scale=scale, masks=masks).refuse_unusable()

    def words(self) -> str:
        """See `TruthFiles.words`."""
        return (
            "chamfer distance in mm: silhouettes widened by 24 px, points 0.2 mm apart, observability mask, points "
            "above the table, distances up to 20 mm"
        )
