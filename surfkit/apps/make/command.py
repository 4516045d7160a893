"""`surfkit make`: from photographs to a delivery, with one command."""

from __future__ import annotations

import platform
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from surfkit.apps.make.extras import wanted
from surfkit.apps.make.quality import QUALITIES, QualityName
from surfkit.apps.make.record import MAKE_RECORD, Delivery, MakeRecord, read_record
from surfkit.apps.make.way import Way
from surfkit.apps.prepare_photos import refuse_overlap
from surfkit.cli.recipes import ARGV
from surfkit.core.check import BadInput
from surfkit.core.codec import dump
from surfkit.core.files import where_now
from surfkit.core.lock import locked
from surfkit.core.version import own_version
from surfkit.io.datasets.data import ReadSettings
from surfkit.io.datasets.read import bare_photographs
from surfkit.raster.select import Device


@dataclass(frozen=True)
class MakeCommand:
    """Go the whole way: from photographs, or a data set, to textured mesh, maps, splats and reports in one folder.

    It finds the cameras where there are none, trains, makes mesh, texture, maps and reports, each in a folder of its
    own in DELIVERY. It asks nothing: DELIVERY/make.json and the output say what was decided. When it is interrupted,
    the same command goes on where it stopped; what is finished is not done again.

    --quality draft: a first look: recipe:surface-short, at most 500 steps, photographs of at most 800 pixels.

    --quality normal: recipe:surface with its own number of steps, photographs of at most 1600 pixels.

    --quality high: recipe:surface with twice the steps, photographs at full size.

    The time of the optimisation is measured and told before it begins. normal and high train recipe:surface-blocks
    instead where one model needs more memory than 90 % of what is free.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE_OR_PHOTOS")]
    """Data set with cameras, or a folder of photographs and videos, or one video; nothing is written among
    photographs."""

    out: Path
    """DELIVERY, the folder for all results."""

    quality: QualityName = "normal"
    """How fine, and how long it takes; see above."""

    steps: int | None = None
    """Optimisation steps instead of those of --quality. When this is raised later, the run continues."""

    reading: Annotated[ReadSettings, tyro.conf.arg(name="")] = ReadSettings()
    """How the data set is read. --longest or --scale replaces the size of --quality."""

    device: Device = "auto"
    """Device for training and rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name
    (`surfkit components rasterizer`)."""

    given: tyro.conf.Suppress[str] = ""

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise BadInput(f"--steps {self.steps}: give 1 or more")
        if not self.given:  # the words of the command line are only known while it is parsed
            object.__setattr__(self, "given", shlex.join(["surfkit", "make", *ARGV.get()]))

    def run(self) -> None:
        """Make the delivery, and print what is in it."""
        photos = self._photos()
        self._refuse_folder(photos)
        reading = QUALITIES[self.quality].reading(self.reading)
        with locked(self.out):
            delivery = self._delivery(reading)
            Way(delivery, photos, self.source, reading, self.quality, self.steps, self.device, wanted()).go()

    def _photos(self) -> Path | None:
        """The photographs or the video whose cameras are to be found; None for a data set.

        Raises:
            BadInput: There is nothing, or a setting does not apply to photographs without cameras.
        """
        if not self.source.exists():
            raise BadInput(f"{self.source}: not there; name a data set, a folder of photographs or a video")
        photos = bare_photographs(self.source) if self.reading.layout is None else None
        given = self.reading
        for flag, value in (("--images", given.images), ("--model", given.model), ("--test-data", given.test_data)):
            if photos is not None and value is not None:
                raise BadInput(
                    f"{flag} {value}: {self.source} holds photographs without cameras, and this is for a data set with "
                    "cameras; leave it out"
                )
        return photos

    def _refuse_folder(self, photos: Path | None) -> None:
        """BadInput if the delivery cannot go where it should."""
        if self.out.exists() and not self.out.is_dir():
            raise BadInput(f"--out {self.out} is a file; name a folder")
        if photos is not None:
            refuse_overlap(self.source, self.out)
        if self.out.is_dir() and not (self.out / MAKE_RECORD).exists():
            names = sorted(path.name for path in self.out.iterdir() if not path.name.startswith(".surfkit-"))
            if names:
                raise BadInput(
                    f"--out {self.out} has {names[0]} and no {MAKE_RECORD}, so `surfkit make` did not make it; name "
                    "another folder"
                )

    def _delivery(self, reading: ReadSettings) -> Delivery:
        """The delivery in the folder, or a new one.

        Raises:
            BadInput: The folder has one of other photographs or settings.
        """
        source = str(self.source.resolve())
        versions = {"surfkit": own_version(), "python": platform.python_version(), "torch": torch.__version__}
        folder = str(self.out.resolve())
        now = MakeRecord(source, self.quality, dump(reading), versions=versions, folder=folder)
        before = read_record(self.out)
        if before is None:
            return Delivery(self.out, now, self.given)
        if before.folder and where_now(Path(before.input), Path(before.folder), self.out.resolve()) == Path(source):
            before.input = source
        remedy = f"give the same again, or name another folder, or delete {self.out}"
        if before.input != now.input:
            raise BadInput(f"--out {self.out} was made of {before.input}, and this is {now.input}; {remedy}")
        if before.quality != now.quality:
            raise BadInput(
                f"--out {self.out} was made with --quality {before.quality}, and this is --quality {now.quality}; "
                f"{remedy}"
            )
        for name, value in now.reading.items():
            if before.reading.get(name) != value:
                flag = f"--{name.replace('_', '-')}"
                raise BadInput(
                    f"--out {self.out} was made with {flag} {before.reading.get(name)}, and this is {flag} {value}; "
                    f"{remedy}"
                )
        before.versions, before.folder = versions, folder
        if before.decisions is not None and self.steps is not None:
            if self.steps < before.decisions.steps and (self.out / "run" / "run.json").exists():
                raise BadInput(
                    f"--steps {self.steps}: the run in {self.out / 'run'} has {before.decisions.steps}, and cannot be "
                    "made shorter; give as many or more, or leave it out"
                )
            before.decisions = before.decisions.longer(self.steps)
        return Delivery(self.out, before, self.given)


COMMAND = MakeCommand
