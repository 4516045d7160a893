"""How cameras and points are found, and where in the data set what led to them is kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from surfkit.apps.sfm.base import FeatureExtractor, FeatureMatcher
from surfkit.apps.sfm.sift import SIFT, PyCOLMAP
from surfkit.core.check import BadInput, require_within
from surfkit.core.registry import choice
from surfkit.scene.pixels import Alpha

WORK_FOLDER, REPORT_FILE = "prepare", "report.json"
"""Folder of the data set for what the stages keep, and what is told of it at the end."""
READOUT_RANGE_MS = (1.0, 500.0)
"""Readout times that a camera may have."""


@dataclass(frozen=True)
class Settings:
    """Settings of structure from motion."""

    longest: int = 1600
    """Features are found in photographs reduced to this longer side, pixels; 3200 is more exact and takes four times as
    long. The photographs that are written keep their size."""

    max_features: int = 8192
    """About how many features are kept of a photograph."""

    features: Annotated[FeatureExtractor, choice(FeatureExtractor)] = SIFT()
    """How features are found: `features:sift`, or others in torch."""

    matcher: Annotated[FeatureMatcher, choice(FeatureMatcher)] = PyCOLMAP()
    """How the features of two photographs are compared."""

    pairs: Literal["auto", "exhaustive", "gps", "sequence", "retrieval"] = "auto"
    """Which photographs are compared: all with all, each with its neighbours by GPS, by time or name, or by likeness
    (sequence too). `auto` compares all of up to 60 photographs, of more those near by GPS, else those alike."""

    neighbours: int = 20
    """How many photographs each is compared with, where not with all."""

    lens: Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"] = "SIMPLE_RADIAL"
    """COLMAP's model of the lens: one or two radial terms, radial and tangential terms, more of both, or a fisheye.
    Photographs of equal camera, size and focal length share a lens."""

    readout: float | Literal["auto", "off"] = "auto"
    """How long the camera reads a photograph, milliseconds from the first row to the last: the motion in that time is
    taken out. `auto` knows some drones, and estimates others from the photographs if they flew; `off` takes all rows
    as exposed at once."""

    mapper: Literal["incremental", "global"] = "incremental"
    """How cameras are placed: one after the other, or all at once, which is faster for thousands of photographs and
    less robust."""

    gps: bool = True
    """Place the scene on Earth by the positions of the photographs. Without it, or without positions, it is only
    levelled."""

    positions: Path | None = None
    """Positions of the photographs in a file, instead of those in EXIF: OpenDroneMap's geo.txt, or a table (CSV) of
    name, x, y, z. A geo.txt beside the photographs, or in the folder above, is found without it."""

    positions_crs: str | None = None
    """Coordinate reference system of --positions, where the file names none."""

    crs: str = "auto"
    """Coordinate reference system of the scene, such as EPSG:2180; auto is that of --positions or geo.txt if it
    is a map, else the zone of UTM."""

    gcp: Path | None = None
    """Ground control points in the format of OpenDroneMap's gcp_list.txt, which then place the scene instead of GPS,
    and are part of the bundle adjustment."""

    gcp_sigma: float = 0.02
    """Standard deviation of each coordinate of the surveyed points, metres."""

    gcp_sigma_up: float | None = None
    """That of their heights, if it is another one."""

    mark_sigma: float = 0.5
    """Standard deviation of each coordinate of their marks in photographs, pixels of the file."""

    checkpoints: int = 0
    """How many of them are held back, to report how far they are off."""

    checkpoint_names: tuple[str, ...] = ()
    """Which of them are held back, by name, instead of so many."""

    frames: int = 300
    """Frames that are taken of a video at most: sharp ones, one for each step that the picture moves."""

    frame_step: float = 0.06
    """That step, as a share of the width of the picture. It becomes larger where there would be too many frames."""

    masks: Path | None = None
    """Folder of masks: pictures called as the photographs, such as NAME.jpg.png or NAME.png. Where they are black,
    features are not taken, and training looks away."""

    seed: int = 0
    """Of all that is drawn at random."""

    alpha: Alpha | None = None
    """What becomes of transparent pixels of photographs: mask makes masks of them, in which no features are found
    either; blend composites them over black, ignore takes their colours as stored. Default: blend, but ignore where a
    fourth band of a TIFF file is no opacity."""

    @property
    def worst_gcp_sigma(self) -> float:
        """Standard deviation of the least accurate coordinate of the surveyed points, metres."""
        return max(self.gcp_sigma, self.gcp_sigma_up or 0.0)

    def __post_init__(self) -> None:
        ranges = {
            "longest": (100, 20_000),
            "max_features": (100, 100_000),
            "frames": (3, 10_000),
            "neighbours": (1, 1000),
        }
        require_within({"frame_step": (0.005, 0.5)}, self)
        require_within({**ranges, "checkpoints": (0, 1000), "seed": (0, 2**31 - 1)}, self)
        require_within({"gcp_sigma": (0.001, 100.0), "mark_sigma": (0.05, 100.0)}, self)
        if not isinstance(self.readout, str) and not READOUT_RANGE_MS[0] <= abs(self.readout) <= READOUT_RANGE_MS[1]:
            raise BadInput(
                f"--readout {self.readout:g}: milliseconds from the first row to the last, {READOUT_RANGE_MS[0]:g} to "
                f"{READOUT_RANGE_MS[1]:g}, less than 0 where the last row is read first; or auto, or off"
            )
        if self.gcp_sigma_up is not None:
            require_within({"gcp_sigma_up": (0.001, 100.0)}, self)
        if self.gcp is None:
            for name in ("gcp_sigma", "gcp_sigma_up", "mark_sigma"):
                if getattr(self, name) != getattr(type(self), name):
                    option = f"--{name.replace('_', '-')}"
                    raise BadInput(f"{option} is how exact the points of --gcp FILE are, which is not given")
        if self.checkpoint_names and self.gcp is None:
            raise BadInput("--checkpoint-names holds back points of --gcp FILE, which is not given")
        if self.checkpoint_names and self.checkpoints:
            raise BadInput("--checkpoints and --checkpoint-names both say what is held back; leave out one of the two")
        if self.checkpoints and self.gcp is None:
            raise BadInput("--checkpoints holds back some points of --gcp FILE, which is not given")
        if self.crs != "auto" and not self.gps and self.gcp is None:
            raise BadInput(f"--crs {self.crs} needs positions, which --no-gps leaves out; leave out one of the two")
        if self.positions is not None and not self.gps:
            raise BadInput("--positions gives positions, which --no-gps leaves out; leave out one of the two")
        if self.positions_crs is not None and self.positions is None:
            raise BadInput("--positions-crs is that of --positions FILE, which is not given")
        if not self.crs.strip():
            raise BadInput("crs is empty; name one, such as EPSG:32633, or auto")
        self.matcher.refuse_unfit(self.features)

    @property
    def in_torch(self) -> bool:
        """Whether features are found or compared on the device that is given."""
        return self.features.in_torch or self.matcher.in_torch

    def refuse_missing(self) -> None:
        """BadInput if packages or weights for features are not on this machine."""
        self.features.refuse_missing()
        self.matcher.refuse_missing(self.features.descriptors)
