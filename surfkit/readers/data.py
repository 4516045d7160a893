"""Which data set, at which size, and which of its photographs are kept from training."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from surfkit.core.check import BadInput

LONGEST = 1600
"""Default for the longest side of a photograph, pixels."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How a data set is read: at which size, from which of its files, and what is kept from training."""

    scale: float | None = None
    """Divide the size of every photograph by this, such as 4 or 3.4175; where images_4/ holds them all, use those."""

    longest: int | None = None
    """Longest side of a photograph in pixels; larger ones are reduced. 1600 when no scale is given."""

    test_every: int = 8
    """Keep every Nth photograph from training, in name order from the first on, to measure with; 0 keeps none. A data
    set with test photographs of its own keeps those."""

    test_list: Path | None = None
    """Keep the photographs named in this file from training instead: one name a line, as below images/."""

    images: Path | None = None
    """Folder of the photographs, when it is not images/; relative to the data set."""

    masks: Path | None = None
    """Folder of the masks, when none of the folders called masks; relative to the data set. Black is ignored."""

    layout: str | None = None
    """How the data set is laid out, such as colmap (`surfkit components reader` lists them); recognised if left out."""

    white: bool = False
    """Lay transparent pixels of photographs over white instead of black."""

    metres_per_unit: float | None = None
    """Metres in a unit of the data set's coordinates, where it does not say. Settings in metres need it."""

    model: Path | None = None
    """Folder of the COLMAP model, such as sparse/1, where there are several; the one of most photographs by default."""

    split: Literal["gauu-scene"] | None = None
    """Keep the photographs from training that a paper kept: gauu-scene, of n, every k-th in the order of COLMAP's
    numbers, k = n // ceil(n / 10)."""

    test_data: Path | None = None
    """Another data set, of the same layout and in the same coordinates, whose photographs are all kept from training:
    the test folder of MatrixCity as CityGaussian prepares it."""

    def __post_init__(self) -> None:
        if self.scale is not None and not 1 <= self.scale < float("inf"):
            raise BadInput(f"--scale {self.scale:g}: it divides the size, so it must be 1 or more")
        if self.longest is not None and self.longest < 1:
            raise BadInput(f"--longest {self.longest}: it is the longest side in pixels, so it must be 1 or more")
        if sum(given is not None for given in (self.split, self.test_list, self.test_data)) > 1:
            raise BadInput("--split, --test-list and --test-data each choose what is kept from training; give one")
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise BadInput(f"--metres-per-unit {self.metres_per_unit:g}: it must be more than 0")
        if self.test_every < 0:
            raise BadInput(f"--test-every {self.test_every}: it must be 0 (keep no photograph from training) or more")

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height to use, for a photograph of `width` x `height` pixels; never larger than it is."""
        longest = self.longest or (LONGEST if self.scale is None else max(width, height))
        by = max(self.scale or 1.0, max(width, height) / longest)
        return max(1, round(width / by)), max(1, round(height / by))

    def held_out(self, names: Sequence[str], own: Collection[str] | None = None) -> set[str]:
        """Which photographs are kept from training.

        Args:
            names: Of all photographs, in the data set's own order.
            own: Those that the data set itself keeps; None if it keeps none.
        """
        chosen = set(sorted(names)[:: self.test_every]) if self.test_every else set()
        if own is not None:
            chosen = set(own)
        if self.split is not None:
            chosen = set(names[:: len(names) // math.ceil(len(names) / 10)])
        if self.test_list is not None:
            chosen = _listed(self.test_list, names)
        if len(chosen) == len(names):
            what = f"--test-every {self.test_every}" if own is None else "the data set's own split"
            what = f"--split {self.split}" if self.split else what
            what = f"--test-list {self.test_list}" if self.test_list else what
            raise BadInput(f"{what} keeps all {len(names)} photographs from training; use --test-every 0 to keep none")
        return chosen

    def of(self, path: Path) -> Data:
        """The data set at `path`, read so."""
        return Data(path, **{field.name: getattr(self, field.name) for field in fields(Reading)})


@dataclass(frozen=True)
class Data(Reading):
    """A data set and how it is read."""

    path: Annotated[Path, tyro.conf.arg(name="data")]
    """Folder of the data set: images/ and a COLMAP model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, or
    another layout that `surfkit components reader` lists."""

    priors: Annotated[Path | None, tyro.conf.Suppress] = None
    """Folder of the depth maps that a run made for it, where it has none of its own."""


def nearest(name: str, known: Sequence[str]) -> str:
    """A question to add to a message, such as "; did you mean 'a.jpg'?", or "" when nothing is near."""
    lower = {other.lower(): other for other in known}
    close = difflib.get_close_matches(name.lower(), lower, n=1)
    return f"; did you mean {lower[close[0]]!r}?" if close else ""


def _listed(path: Path, names: Sequence[str]) -> set[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"--test-list {path}: cannot be read as text: {_reason(error)}") from error
    chosen = {line.strip() for line in lines} - {""}
    if not chosen:
        raise BadInput(f"--test-list {path}: names no photograph; write one name a line")
    for name in sorted(chosen - set(names)):
        raise BadInput(f"--test-list {path}: no photograph {name!r} in the model{nearest(name, names)}")
    return chosen


def _reason(error: OSError | UnicodeDecodeError) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else "it is not UTF-8"
