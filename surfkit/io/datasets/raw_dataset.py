"""What a reader finds in a data set: photographs with poses and lenses, and sparse points, in the input's frame."""

from __future__ import annotations

import signal
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput


@dataclass(frozen=True)
class RawImage:
    """A photograph as the data set has it.

    Attributes:
        name: As the data set spells it; unique in the data set.
        pose: (4, 4) float64 world_to_camera, input frame.
        camera: pycolmap.Camera of any model; its size may be another one than the photograph's.
        path: The photograph on disk.
        mask: Its mask, where the data set names one; None leaves it to be found by its name.
    """

    name: str
    pose: np.ndarray
    camera: Any
    path: Path
    mask: Path | None = None


@dataclass(frozen=True)
class RawDataset:
    """A data set as it is.

    Attributes:
        shots: At least one, in the data set's own order: COLMAP's is that of its image numbers.
        xyz: (P, 3) float64 sparse points, input frame; none if the data set has none.
        rgb: (P, 3) uint8.
        held_out: Names that the data set itself keeps from training; None leaves it to `Data`.
        metres: Metres per unit of the input frame; None where the data set does not say.
        crs: Coordinate reference system of the input frame; None where there is none.
        shift: What files of these coordinates are to leave out; None leaves it to `Frame.around`.
        groups: Names of photographs that sparse points connect, the largest group first; none where the layout keeps no
            observations.
        numbered: Whether the order of the photographs is that of the numbers which COLMAP has given them.
    """

    shots: Sequence[RawImage]
    xyz: np.ndarray
    rgb: np.ndarray
    held_out: frozenset[str] | None = None
    metres: float | None = None
    crs: str | None = None
    shift: tuple[float, float, float] | None = None
    groups: Sequence[Sequence[str]] = ()
    numbered: bool = False

    def untied(self, held_out: Collection[str]) -> list[str]:
        """Names of the photographs to train on that show no sparse point; none where the layout keeps no observations.

        Args:
            held_out: Names of those that are not trained on.
        """
        tied = {name for group in self.groups for name in group}
        names = [shot.name for shot in self.shots if shot.name not in held_out]
        return [name for name in names if name not in tied] if tied else []


@dataclass(frozen=True)
class Tracks:
    """Which sparse points were seen where.

    Attributes:
        xyz: (P, 3) float64, input frame.
        error_px: (P,) float64 mean reprojection error.
        seen: By name of the photograph: (K,) int64 rows of xyz, (K, 2) float64 pixels of the camera of its shot.
        cameras: By name of the photograph: the camera.
    """

    xyz: np.ndarray
    error_px: np.ndarray
    seen: Mapping[str, tuple[np.ndarray, np.ndarray]]
    cameras: Mapping[str, Any]


def camera_of(where: str, model: str, size: tuple[int, int], params: Sequence[float]) -> Any:
    """A pycolmap camera, or BadInput that names `where` its numbers come from."""
    try:
        return load_pycolmap().Camera(model=model, width=size[0], height=size[1], params=list(params))
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        numbers = ", ".join(f"{value:g}" for value in params)
        raise BadInput(f"{where}: no {model} camera has size {size[0]} x {size[1]} and parameters {numbers}") from error


def shorten(value: object) -> str:
    """What a file has in the place of something else, in a few words."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def load_pycolmap() -> Any:
    """The module pycolmap, loaded after Pillow's PNG writer: the other way round, saving a PNG kills the process.

    SIGTERM does what it did before: pycolmap would abort with a trace of the stack.
    """
    import PIL.PngImagePlugin  # noqa: F401

    try:
        import pycolmap
    except (ImportError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise BadInput(f"pycolmap cannot be loaded: {reason}; is it installed, and is there memory for it?") from error
    handler = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is threading.main_thread() and handler is not None:
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
