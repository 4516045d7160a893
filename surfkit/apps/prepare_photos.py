"""`surfkit prepare photos`: from photographs to a data set."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from surfkit.apps.prepare_depth import OVERVIEW, PrepareDepthCommand
from surfkit.apps.sfm.control_report import point_rows
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.settings import REPORT_FILE, WORK_FOLDER, Settings
from surfkit.apps.sfm.sfm_pipeline import CAMERAS_PICTURE, SfmPreparation
from surfkit.cli.console_table import print_table, tell
from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json, write_json
from surfkit.core.events import Warned, emit
from surfkit.core.files import sweep
from surfkit.core.lock import locked
from surfkit.core.registry import choice
from surfkit.core.stages import StageFolder, key_of
from surfkit.depth.base import DepthEstimator
from surfkit.depth.prepare_depth_maps import DepthPreparation as DepthMaps
from surfkit.io.datasets.data import Data, ReadSettings
from surfkit.io.datasets.depth_files import DEPTH_FOLDER, read_record
from surfkit.io.datasets.depth_prior import trust_warning
from surfkit.io.datasets.read import read
from surfkit.raster.select import Device, torch_device
from surfkit.runs.run_notes import collect_notes
from surfkit.scene.camera import Camera
from surfkit.scene.photo_names import VIDEO_SUFFIXES, is_video
from surfkit.scene.scene import View
from surfkit.train.progress_bars import bars

LISTED_PHOTOS = 10
"""Photographs without a camera that are listed."""


@dataclass(frozen=True)
class PreparePhotosCommand:
    """Find the cameras of a folder of photographs, or of a video, by structure from motion, and write a data set that
    `surfkit train` reads.

    SCENE gets undistorted photographs in images/, a COLMAP model in sparse/0, report.json and cameras.png. With
    positions in EXIF, XMP or geo.txt it lies on the map, else it is level. An interrupted command continues when it is
    given again; one with other settings or photographs does again only what depends on them. `depth:patch-match` or
    another estimator makes depth maps too, as `surfkit prepare depth SCENE` does.
    """

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder of photographs and videos, in folders inside it or not, or one video; nothing is written there."""

    out: Path | None = None
    """SCENE, the folder of the data set; by default FOLDER-scene beside the folder of photographs, or VIDEO-scene."""

    settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()
    """How cameras are found."""

    depth: Annotated[DepthEstimator | None, choice(DepthEstimator, optional=True)] = None
    """How depth maps are estimated at the end, to SCENE/estimated_depths. By default they are not: `surfkit train`
    makes those that its recipe uses."""

    device: Device = "auto"
    """Device for depth maps, and for features and matchers in torch: auto, cpu, cuda, cuda:1, or that of a rasterizer,
    by its name (`surfkit components rasterizer`)."""

    def __post_init__(self) -> None:
        if self.depth is None and self.device != "auto" and not self.settings.in_torch:
            raise BadInput(
                f"--device {self.device} is for depth maps and for features and matchers in torch, and there are none; "
                "add depth:patch-match or features:kornia-sift"
            )

    @property
    def scene(self) -> Path:
        """The folder of the data set."""
        name = self.photos.stem if is_video(self.photos) else self.photos.resolve().name
        return self.out or self.photos.resolve().with_name(f"{name}-scene")

    def run(self) -> None:
        """Prepare, and print the results and what to do next."""
        self.prepare()
        uses = ", which uses the depth maps if its losses or its mesh look at some" if self.depth is not None else ""
        tell(f"next: `surfkit train recipe:surface --data {shlex.quote(str(self.scene))}`{uses}")

    def prepare(self) -> None:
        """Prepare, and print the results."""
        root, scene = self.photos, self.scene
        if not root.is_dir() and not is_video(root):
            what = "a file, and no video that is known by its ending" if root.exists() else "no such folder"
            raise BadInput(
                f"{root}: {what}; name a folder of photographs, or a video ({', '.join(sorted(VIDEO_SUFFIXES))})"
            )
        refuse_overlap(root, scene)
        refuse_foreign(scene)
        if self.depth is not None:
            torch_device(self.device)
            self.depth.refuse_missing()
            refuse_foreign_maps(scene)
        device = torch_device(self.device) if self.settings.in_torch else torch.device("cpu")
        with collect_notes(), locked(scene / WORK_FOLDER):
            before = maps_before(scene)
            with bars():
                sweep(scene)
                report = SfmPreparation(root, scene, self.settings, self._refuse_unfit, device).run()
            if self.depth is not None:
                write_json(scene / REPORT_FILE, report | {"depth_maps": {"estimator": self.depth}})  # to go on from
                report |= self._depth_maps(self.depth)
            elif before is not None:
                report["depth_maps"] = before
                warn_outdated(scene, before)
            write_json(scene / REPORT_FILE, report)
        show(report, scene)

    def _refuse_unfit(self, photos: Sequence[Photo]) -> None:
        """BadInput if the estimator of depth does not fit photographs of these sizes."""
        if self.depth is not None:
            self.depth.refuse_unfit([_view(photo, *ReadSettings().size(*photo.size)) for photo in photos])

    def _depth_maps(self, estimator: DepthEstimator) -> dict[str, Any]:
        """Make the depth maps that are not there; what the report says of them, and the time of all stages."""
        stages, command = (
            StageFolder(self.scene / WORK_FOLDER),
            PrepareDepthCommand(self.scene, estimator, device=self.device),
        )
        done = stages.run("depth maps", key_of(estimator), lambda: command.make(renew=True))
        preparation = DepthMaps(Data(self.scene, test_every=0), estimator, torch_device(self.device))
        scene = read(preparation.data)
        count, lacking = len(preparation.views(scene)), preparation.lacking(scene)
        covered = [step.coverage for step in done if step.coverage is not None]
        if covered and (text := trust_warning(sum(covered) / len(covered))):
            emit(Warned(text))
        found = {"estimator": estimator, "photographs": count - len(lacking), "of": count, "without": lacking}
        return {"depth_maps": found, "seconds": stages.seconds()}


def as_before(photos: Path, device: Device) -> PreparePhotosCommand:
    """The command as it was last completed for a folder of photographs; with the usual settings where it was not.

    Args:
        photos: The folder.
        device: Where depth maps are made and torch finds and compares features, if so.

    Raises:
        BadInput: The report of the scene is damaged.
    """
    usual = PreparePhotosCommand(photos)
    report = usual.scene / REPORT_FILE
    if not (usual.scene / WORK_FOLDER).is_dir() or not report.is_file():
        return usual
    try:
        told = read_json(report, dict[str, Any])
        settings, maps = load(Settings, told["settings"]), maps_before(usual.scene)
        if maps is None:
            return replace(usual, settings=settings, device=device if settings.in_torch else "auto")
        return replace(usual, settings=settings, depth=load(DepthEstimator, maps["estimator"]), device=device)
    except (BadInput, KeyError, TypeError) as error:
        raise BadInput(f"{report}: damaged, or of another version; delete it to prepare the scene again") from error


def refuse_overlap(root: Path, scene: Path) -> None:
    """BadInput if a data set is to be written among the photographs, where it would be taken for some of them."""
    if scene.resolve().is_relative_to(root.resolve()):
        raise BadInput(f"--out {scene} lies in the folder of photographs {root}; name one outside")


def refuse_foreign(scene: Path) -> None:
    """BadInput if a folder has a model or photographs that another program made: they would be replaced."""
    if scene.exists() and not scene.is_dir():
        raise BadInput(f"--out {scene} is a file; name a folder")
    if (scene / WORK_FOLDER).is_dir():
        return
    if found := next((name for name in ("sparse", "images", REPORT_FILE) if (scene / name).exists()), None):
        raise BadInput(f"--out {scene} has {found} that this command did not make; name another folder")


def refuse_foreign_maps(scene: Path) -> None:
    """BadInput if a scene has depth maps that surfkit did not make: they would be replaced."""
    if not read_record(scene) and any((scene / DEPTH_FOLDER).rglob("*.npy")):
        raise BadInput(
            f"{scene / DEPTH_FOLDER} holds depth maps that surfkit did not make; move it away, or make none: leave out "
            "depth:NAME"
        )


def maps_before(scene: Path) -> dict[str, Any] | None:
    """What the report of a scene says of the depth maps that this command made; None where there are none."""
    try:
        maps = read_json(scene / REPORT_FILE, dict[str, Any]).get("depth_maps")
    except BadInput:
        return None
    return maps if isinstance(maps, dict) and (scene / DEPTH_FOLDER).is_dir() else None


def warn_outdated(scene: Path, maps: dict[str, Any]) -> None:
    """Say that the depth maps of a scene were made from other cameras or photographs than it has now, if so."""
    data = Data(scene, test_every=0)
    try:
        preparation = DepthMaps(data, load(DepthEstimator, maps.get("estimator")), torch.device("cpu"))
        outdated = preparation.is_outdated(preparation.material(read(data)))
    except BadInput:  # of an estimator that is not here, or that the photographs do not suit any more
        outdated = True
    if outdated:
        what = "has depth maps of other cameras or photographs, which training would use"
        emit(Warned(f"{scene / DEPTH_FOLDER} {what}; depth:NAME renews them"))


def _view(photo: Photo, width: int, height: int) -> View:
    """A photograph before its camera is known."""
    camera = Camera(torch.eye(4, dtype=torch.float64), width, width, width / 2, height / 2, width, height)
    return View(photo.name, camera, Path(photo.name))


def rolling_rows(rolling: dict[str, Any]) -> list[tuple[str, str]]:
    """What is told of rolling shutters; nothing where none was found or given."""
    if not rolling["corrected"]:
        return [("rolling shutter", f"not corrected: {rolling['why_not']}")] if rolling["lenses"] else []
    lenses = [lens for lens in rolling["lenses"] if lens["ms"] is not None]
    times = "; ".join(f"{lens['ms']:.3g} ms ({lens['source']})" for lens in lenses)
    before, after = rolling["reprojection_error_px"]
    shift = (
        f"{rolling['corrected']} photographs, {rolling['first_to_last_row_px']:.1f} px from the first row to the last"
    )
    return [
        ("rolling shutter", f"{times}, {shift}; reprojection error {before:.2f} px without it, {after:.2f} with it")
    ]


def show(report: dict[str, Any], scene: Path) -> None:
    """Print what was found, what was not, and where it lies."""
    models = report["models"]
    rows = [("photographs", f"{report['registered']} of {report['photographs']} have a camera")]
    first = models[0]
    rows.append(("points", f"{first['points']:,}, each in {first['track_length']:.1f} photographs on average"))
    rows.append(("reprojection error", f"{first['reprojection_error_px']:.2f} px"))
    lenses, heights = first["weighed"]["focal_lengths_px"], first["weighed"]["heights_times"]
    lens, more = lenses[0], f" (first of {len(lenses)} lenses)" if len(lenses) > 1 else ""
    exif = "none in EXIF" if lens["exif"] is None else f"{lens['exif']:.0f} px in EXIF"
    said = f"{exif}, {lens['photographs_alone']:.0f} by the photographs alone, {lens['final']:.0f} in the end{more}"
    times = f"{heights:.2f}"
    changed = f"; heights are {times} times those by the photographs alone" if times != "1.00" else ""
    rows.append(("focal length", f"{said}{changed}"))
    rows += rolling_rows(first["rolling_shutter"])
    if place := first.get("georeference"):
        east, north, up = (place["rms_m"][axis] for axis in "enu")
        rows.append(("on the map", f"{place['crs']}, offset {' '.join(f'{value:.0f}' for value in place['offset'])}"))
        above = f", {up:.2f} up" if up is not None else ""
        rows.append(
            ("residuals (RMS)", f"{east:.2f} m east, {north:.2f} north{above}, of {place['positions']} photographs")
        )
    if ground := first.get("ground_control"):
        rows.append(("on the map", f"{ground['crs']}, offset {' '.join(f'{value:.0f}' for value in ground['offset'])}"))
        for what in ("control", "checkpoints"):
            if rms := ground[f"{what}_rms_m"]:
                said = f"{rms['e']:.2f} m east, {rms['n']:.2f} north, {rms['u']:.2f} up, of {len(ground[what])} points"
                rows.append((f"{what} (RMS)", said))
    if len(models) > 1:
        others = ", ".join(f"sparse/{at} of {model['photographs']}" for at, model in enumerate(models[1:], 1))
        rows.append(("other groups", f"{others} (--model sparse/1 trains one)"))
    if "photographs" in (maps := report.get("depth_maps") or {}):
        rows.append(("depth maps", f"of {maps['photographs']} of {maps['of']} photographs that are trained on"))
    rows.append(("seconds", ", ".join(f"{name} {value:.0f}" for name, value in report["seconds"].items())))
    print_table(("cameras", "value"), rows)
    if ground := first.get("ground_control"):
        print_table(("point", "role", "east, m", "north, m", "up, m", "marks, px (RMS)"), point_rows(ground))
    lost = report["not_registered"]
    for name, why in list(lost.items())[:LISTED_PHOTOS]:
        tell(f"no camera for {name!r}: {why}")
    if len(lost) > LISTED_PHOTOS:
        tell(f"and for {len(lost) - LISTED_PHOTOS} more: see {scene / REPORT_FILE}")
    tell(f"data set in {str(scene)!r}; picture of its cameras: {str(scene / CAMERAS_PICTURE)!r}")
    if report.get("depth_maps"):
        tell(f"depth maps in {str(scene / DEPTH_FOLDER)!r}; picture of some: {str(scene / DEPTH_FOLDER / OVERVIEW)!r}")
