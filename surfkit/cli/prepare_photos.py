"""`surfkit prepare photos`: from photographs to a data set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from surfkit.cli.table import print_table
from surfkit.core.check import BadInput
from surfkit.core.codec import load, read_json
from surfkit.core.files import sweep
from surfkit.core.lock import locked
from surfkit.run.notes import collect_notes
from surfkit.sfm.prepare import PICTURE, Preparation
from surfkit.sfm.settings import REPORT, WORK, Settings
from surfkit.train.bars import bars

SHOWN = 10
"""Photographs without a camera that are listed."""


@dataclass(frozen=True)
class Photos:
    """Find the cameras of a folder of photographs by structure from motion, and write a data set that
    `surfkit train` reads.

    SCENE gets undistorted photographs in images/, a COLMAP model in sparse/0, report.json and cameras.png. With
    positions in EXIF it lies on the map, else it is level. An interrupted command continues when it is given again; one
    with other settings or photographs does again only what depends on them.
    """

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """Folder of photographs, in folders inside it or not; nothing is written there."""

    out: Path | None = None
    """SCENE, the folder of the data set; by default FOLDER-scene beside the folder of photographs."""

    settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()
    """How cameras are found."""

    @property
    def scene(self) -> Path:
        """The folder of the data set."""
        return self.out or self.photos.resolve().with_name(f"{self.photos.resolve().name}-scene")

    def run(self) -> None:
        """Prepare, and print the results."""
        root, scene = self.photos, self.scene
        if not root.is_dir():
            raise BadInput(f"{root}: {'a file' if root.exists() else 'no such folder'}; name a folder of photographs")
        refuse_overlap(root, scene)
        refuse_foreign(scene)
        with collect_notes(), bars(), locked(scene / WORK):
            sweep(scene)
            report = Preparation(root, scene, self.settings).run()
        show(report, scene)


def settings_of(scene: Path) -> Settings:
    """The settings that a scene was prepared with; the usual ones where none is complete."""
    report = scene / REPORT
    if not (scene / WORK).is_dir() or not report.is_file():
        return Settings()
    try:
        return load(Settings, read_json(report, dict[str, Any])["settings"])
    except (BadInput, KeyError) as error:
        raise BadInput(f"{report}: damaged, or of another version; delete it to prepare the scene again") from error


def refuse_overlap(root: Path, scene: Path) -> None:
    """BadInput if a data set is to be written among the photographs, where it would be taken for some of them."""
    if scene.resolve().is_relative_to(root.resolve()):
        raise BadInput(f"--out {scene} lies in the folder of photographs {root}; name one outside")


def refuse_foreign(scene: Path) -> None:
    """BadInput if a folder has a model or photographs that another program made: they would be replaced."""
    if scene.exists() and not scene.is_dir():
        raise BadInput(f"--out {scene} is a file; name a folder")
    if (scene / WORK).is_dir():
        return
    if found := next((name for name in ("sparse", "images", REPORT) if (scene / name).exists()), None):
        raise BadInput(f"--out {scene} has {found} that this command did not make; name another folder")


def show(report: dict[str, Any], scene: Path) -> None:
    """Print what was found, what was not, and where it lies."""
    models = report["models"]
    rows = [("photographs", f"{report['registered']} of {report['photographs']} have a camera")]
    first = models[0]
    rows.append(("points", f"{first['points']:,}, each in {first['track_length']:.1f} photographs on average"))
    rows.append(("reprojection error", f"{first['reprojection_error_px']:.2f} px"))
    if place := first.get("georeference"):
        east, north, up = (place["rms_m"][axis] for axis in "enu")
        rows.append(("on the map", f"{place['crs']}, offset {' '.join(f'{value:.0f}' for value in place['offset'])}"))
        rows.append(("residuals (RMS)", f"{east:.2f} m east, {north:.2f} north, {up:.2f} up of {place['positions']}"))
    if ground := first.get("ground_control"):
        rows.append(("on the map", f"{ground['crs']}, offset {' '.join(f'{value:.0f}' for value in ground['offset'])}"))
        for what in ("control", "checkpoints"):
            if rms := ground[f"{what}_rms_m"]:
                said = f"{rms['e']:.2f} m east, {rms['n']:.2f} north, {rms['u']:.2f} up of {len(ground[what])}"
                rows.append((f"{what} (RMS)", said))
    if len(models) > 1:
        others = ", ".join(f"sparse/{at} of {model['photographs']}" for at, model in enumerate(models[1:], 1))
        rows.append(("other groups", f"{others} (--model sparse/1 trains one)"))
    rows.append(("seconds", ", ".join(f"{name} {value:.0f}" for name, value in report["seconds"].items())))
    print_table(("cameras", "value"), rows)
    lost = report["not_registered"]
    for name, why in list(lost.items())[:SHOWN]:
        print(f"no camera for {name!r}: {why}")
    if len(lost) > SHOWN:
        print(f"and for {len(lost) - SHOWN} more: see {scene / REPORT}")
    print(f"data set in {scene}; look at {scene / PICTURE}")
