"""Where the points of a stage are kept: an option of how a run is executed, and not of its recipe."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import psutil
import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.files import refuse_unwritable
from surfkit.primitives.base import Primitive
from surfkit.primitives.storage import DiskStorage, Storage
from surfkit.train.in_view import why_all
from surfkit.train.stage import Stage

Place = Literal["auto", "device", "host", "disk"]
PLACES = {"host": "in the memory of the CPU", "disk": "in files on the disk"}
"""Where points that are not kept where they are drawn are, in words."""
IN_MEMORY = {"tmpfs", "ramfs"}
"""File systems whose files take memory."""


@dataclass(frozen=True)
class PointsOn:
    """Where points are kept, with their moments and statistics. On a CPU, the result does not depend on it.

    Attributes:
        place: "device": where they are drawn; "host": in the memory of the CPU; "disk": in files that are mapped into
            memory; "auto": on the device, and when its memory gives out, on the host, then on the disk.
        scratch: Folder for the files; None for that of the stage.
    """

    place: Place = "auto"
    scratch: Path | None = None

    def __post_init__(self) -> None:
        if self.place not in get_args(Place):
            raise BadInput(f"points_on {self.place!r}: give one of {', '.join(get_args(Place))}")

    def refuse_unfit(self, stages: Iterable[tuple[str, Stage, Primitive]]) -> None:
        """BadInput where points cannot be kept there; stages with their path in the recipe, and what their points
        are."""
        if self.scratch is not None:
            if self.place in ("device", "host"):
                raise BadInput(
                    f"--scratch {self.scratch}: no files are made with --points-on {self.place}; leave it out, or use "
                    "--points-on disk"
                )
            if not self.scratch.is_dir():
                raise BadInput(f"--scratch {self.scratch}: there is no such folder; make it, or name another")
            refuse_unwritable(self.scratch)
        if self.place not in PLACES:
            return
        for path, stage, primitive in stages:
            if why := why_all(stage, primitive):
                raise BadInput(
                    f"--points-on {self.place} is for stages whose steps need only the points in view, and "
                    f"{path}.{why}, or use --points-on auto"
                )

    def home(self, folder: Path) -> Storage | None:
        """The storage of a stage; None for that of the device that draws. `folder`: of the stage."""
        return None if self.place in ("auto", "device") else self.storage(self.place, folder)

    def storage(self, place: Place, folder: Path) -> Storage:
        """That of a place, "host" or "disk"; a warning says so where the disk is none."""
        if place == "host":
            return Storage(torch.device("cpu"))
        folder = self.scratch or folder
        folder.mkdir(parents=True, exist_ok=True)
        if (kind := _file_system(folder)) in IN_MEMORY:
            emit(Warned(f"{folder} is in memory ({kind}), so points there save none; name another with --scratch"))
        return DiskStorage(folder=folder)

    def next_place(self, now: Storage, stage: Stage, primitive: Primitive) -> Place | None:
        """Where the points are to go when the memory that they are in has given out; None if they stay."""
        if self.place != "auto" or isinstance(now, DiskStorage) or why_all(stage, primitive):
            return None
        return "disk" if now.device is None or now.device.type == "cpu" else "host"


def _file_system(folder: Path) -> str:
    """The kind of file system that a folder is on."""
    folder = folder.resolve()
    around = [each for each in psutil.disk_partitions(all=True) if folder.is_relative_to(each.mountpoint)]
    return max(around, key=lambda each: len(each.mountpoint)).fstype if around else ""
