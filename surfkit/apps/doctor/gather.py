"""What a reader finds in a data set, with everything that it objects to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.doctor.finding import Finding, from_errors
from surfkit.core.check import BadInput, collecting
from surfkit.core.events import Warned
from surfkit.core.hooks import hookimpl
from surfkit.core.registry import name_of, plugins
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DepthFile
from surfkit.io.datasets.depth_layout import DepthQuery, find_maps
from surfkit.io.datasets.masks import MASKS_FOLDER, find_masks, masked_name, with_opacity
from surfkit.io.datasets.panoramas import view_names
from surfkit.io.datasets.pixel_interpretation import PixelInterpretation, decide
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.read import bare_photographs, model_folder, read_capture, reader_of
from surfkit.scene.photo_names import PICTURE_SUFFIXES
from surfkit.scene.pixels import DEFAULT_PIXELS, Pixels
from surfkit.scene.scene import Mask

EMPTY = RawDataset((), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@dataclass(frozen=True)
class Gathered:
    """A data set as far as it can be read.

    Attributes:
        layout: The name of its reader; None if no reader could be chosen.
        capture: What could be read; its shots in name order. Photographs need not exist.
        masks: By name of the photograph.
        held_out: Names that are kept from training.
        pixels: What the values of the photographs that are there mean, by name.
        loose: Pictures beside the photographs that have no pose; all pictures where nothing has one.
        findings: What the reader, the masks and the split give rise to.
    """

    layout: str | None
    capture: RawDataset
    masks: dict[str, Mask]
    held_out: frozenset[str]
    pixels: Mapping[str, Pixels]
    loose: tuple[Path, ...]
    findings: tuple[Finding, ...]

    @property
    def train(self) -> list[RawImage]:
        """The shots to train on."""
        return [shot for shot in self.capture.shots if shot.name not in self.held_out]


def gather(data: Data, quick: bool = False) -> Gathered:
    """Read a data set, and go on after every fault that leaves something to be read; no photograph if it is `quick`."""
    with heard() as warnings, collecting() as faults:
        layout, capture = _read(data, faults)
        said, files = list(warnings), {shot.name: shot.path for shot in capture.shots if shot.path.is_file()}
        masks: dict[str, Mask] = {}
        try:
            masks = find_masks(data.path, data.masks, capture.shots) if data.path.is_dir() else {}
        except BadInput as error:
            faults.append(error)
        told = not all(mask.alpha for mask in masks.values())  # in words of its own, how many masks there are
        decided = (
            PixelInterpretation(dict.fromkeys(files, DEFAULT_PIXELS), ())
            if quick
            else decide(files, data.alpha, data.white)
        )
        masks = with_opacity(masks, [shot for shot in capture.shots if shot.name in files], decided)
        said = [*said, *list(warnings)[len(said) + told :], *decided.lines]
        held_out: set[str] = set()
        try:
            held_out = data.held_out(capture) if capture.shots else held_out
        except BadInput as error:
            faults.append(error)
    findings = from_errors("data-set", faults) + from_errors("data-set", map(BadInput, said), "warning")
    loose = _loose(data, capture.shots)
    return Gathered(layout, capture, masks, frozenset(held_out), decided.pixels, loose, tuple(findings))


def depth_maps(data: Data, gathered: Gathered) -> dict[str, DepthFile]:
    """The depth map of each view to train on that has one, by name.

    Raises:
        BadInput: A file that describes the maps is damaged.
    """
    metres = data.metres_per_unit or gathered.capture.metres
    query = DepthQuery(data.path, view_names(gathered.train), model_folder(data), metres)
    return find_maps(query, data.depth_layout)


@contextmanager
def heard() -> Iterator[list[str]]:
    """Within, warnings are not lost: their texts are in the list."""
    listener = _WarningCollector()
    plugins().register(listener)
    try:
        yield listener.texts
    finally:
        plugins().unregister(listener)


class _WarningCollector:
    """Keeps the texts of warnings."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    @hookimpl
    def surfkit_event(self, event: Any) -> None:
        """See one event."""
        if isinstance(event, Warned):
            self.texts.append(event.text)


def _read(data: Data, faults: list[BadInput]) -> tuple[str | None, RawDataset]:
    """The name of the layout, and what its reader could read."""
    layout = None
    try:
        reader = reader_of(data)
        layout = name_of(reader)
        capture = read_capture(data, reader)
    except BadInput as error:
        faults.append(error)
        return layout, EMPTY
    return layout, capture


def _loose(data: Data, shots: Sequence[RawImage]) -> tuple[Path, ...]:
    """Pictures in the folders of the photographs that no shot is of; where there are no shots, all in images/, or in
    the folder itself where surfkit finds their cameras."""
    if not data.path.is_dir():
        return ()
    used = {shot.path for shot in shots}
    named = data.path / (data.images or "images")
    if not shots and data.images is None:
        named = bare_photographs(data.path) or named
    folders = [named] if named.is_dir() else sorted({path.parent for path in used})
    found = (path for folder in folders for path in sorted(folder.rglob("*") if folder == named else folder.glob("*")))
    return tuple(
        path
        for path in found
        if path.suffix.lower() in PICTURE_SUFFIXES
        and path not in used
        and not path.name.startswith(".")  # what macOS keeps beside a photograph
        and not _is_mask(path, data.path)
    )


def _is_mask(path: Path, root: Path) -> bool:
    """Whether a picture is called as masks are."""
    return bool(masked_name(path.name)) or MASKS_FOLDER in path.relative_to(root).parts
