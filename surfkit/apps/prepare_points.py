"""`surfkit prepare points`: from cameras without points to a data set with points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from surfkit.apps.prepare_photos import refuse_foreign
from surfkit.apps.sfm.base import FeatureExtractor, FeatureMatcher
from surfkit.apps.sfm.settings import WORK_FOLDER, Settings
from surfkit.apps.sfm.sift import SIFT, PyCOLMAP
from surfkit.apps.sfm.tie_points import TiePoints
from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput
from surfkit.core.files import sweep
from surfkit.core.lock import locked
from surfkit.core.registry import choice
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import reader_of
from surfkit.raster.select import Device, torch_device
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.pixels import Alpha
from surfkit.train.progress_bars import bars


@dataclass(frozen=True)
class PreparePointsCommand:
    """Match the photographs of a data set whose cameras are known, and triangulate points, which stereo and training
    start from: for cameras of Metashape, Pix4D, RealityCapture or NeRF programs, whose files have none, and for COLMAP
    models of poses alone.

    SCENE gets undistorted photographs in images/ and a COLMAP model in sparse/0, of the same cameras in the same
    coordinates. An interrupted command continues when it is given again.
    """

    data: Annotated[Path, tyro.conf.Positional]
    """Data set of any layout."""

    out: Path | None = None
    """SCENE, the folder of the new data set; by default DATA-scene beside DATA."""

    longest: int = 1600
    """Features are found in photographs reduced to this longer side, pixels."""

    max_features: int = 8192
    """About how many features are kept of a photograph."""

    features: Annotated[FeatureExtractor, choice(FeatureExtractor)] = SIFT()
    """How features are found: `features:sift`, or others in torch."""

    matcher: Annotated[FeatureMatcher, choice(FeatureMatcher)] = PyCOLMAP()
    """How the features of two photographs are compared."""

    device: Device = "auto"
    """Device for features and matchers in torch: auto, cpu, cuda, cuda:1, or that of a rasterizer, by its name."""

    pairs: Literal["poses", "exhaustive"] = "poses"
    """Which photographs are compared: each with those that stand near it and look at the same place, or all with all,
    which takes the square of the time."""

    neighbours: int = 20
    """How many photographs each is compared with, where not with all."""

    seed: int = 0
    """Of all that is drawn at random."""

    layout: str | None = None
    """Layout of the data set, such as metashape (`surfkit components reader` lists them); recognised if left out."""

    images: Path | None = None
    """Folder of the photographs, when it is not images/; relative to the data set."""

    masks: Path | None = None
    """Folder of the masks, if it is not called masks; relative to the data set. No features are found where they are
    black, and they go with SCENE, undistorted."""

    alpha: Alpha | None = None
    """What becomes of transparent pixels of photographs: mask makes masks of them, blend composites them over black,
    ignore takes their colours as stored. Default: blend, but ignore where a fourth band of a TIFF file is no
    opacity."""

    @property
    def scene(self) -> Path:
        """The folder of the new data set."""
        return self.out or self.data.resolve().with_name(f"{self.data.resolve().name}-scene")

    def run(self) -> None:
        """Triangulate, and print the results."""
        data = Data(self.data, layout=self.layout, images=self.images, masks=self.masks, alpha=self.alpha)
        scene = self.scene
        names = ("longest", "max_features", "features", "matcher", "neighbours", "seed")
        settings = Settings(
            pairs="auto" if self.pairs == "poses" else "exhaustive", **{name: getattr(self, name) for name in names}
        )
        if self.device != "auto" and not settings.in_torch:
            raise BadInput(
                f"--device {self.device} is for features and matchers in torch, and there are none; add "
                "features:kornia-sift"
            )
        device = torch_device(self.device) if settings.in_torch else torch.device("cpu")
        reader_of(data)  # or one line that says what is wrong
        if scene.resolve().is_relative_to(self.data.resolve()):
            raise BadInput(f"--out {scene} lies in the data set {self.data}; name a folder outside")
        refuse_foreign(scene)
        with collect_notes(), bars(), locked(scene / WORK_FOLDER):
            sweep(scene)
            report = TiePoints(data, scene, settings, device).run()
        show(report, scene)


def show(report: dict[str, Any], scene: Path) -> None:
    """Print what came of it, and where it lies."""
    model = report["models"][0]
    rows = [
        ("photographs", f"{report['registered']} of {report['photographs']}, with the cameras that they had"),
        ("points", f"{model['points']:,}, each in {model['track_length']:.1f} photographs on average"),
        ("reprojection error", f"{model['reprojection_error_px']:.2f} px"),
        ("seconds", ", ".join(f"{name} {value:.0f}" for name, value in report["seconds"].items())),
    ]
    print_table(("points", "value"), rows)
    tell(f"data set in {scene}")
