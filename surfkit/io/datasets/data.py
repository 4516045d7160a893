"""Which data set, at which size, and which of its photographs are held out."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from surfkit.core.check import BadInput, few, reject
from surfkit.core.events import Warned, emit
from surfkit.core.registry import choice, name_of
from surfkit.io.datasets.depth_layout import DepthLayout
from surfkit.io.datasets.raw_dataset import RawDataset
from surfkit.io.datasets.split import Split
from surfkit.scene.pixels import Alpha

DEFAULT_LONGEST_PX = 1600
"""Default for the longest side of a photograph, pixels."""
TEST_EVERY = 8
"""Default for which photographs are held out: every so many-th; 0 for none."""


@dataclass(frozen=True, kw_only=True)
class ReadSettings:
    """How a data set is read: at which size, from which of its files, and which photographs are held out."""

    scale: float | None = None
    """Divide the size of every photograph by this, such as 4 or 3.4175; where images_4/ holds them all, use those."""

    longest: int | None = None
    """Longest side of a photograph in pixels; larger ones are downscaled. 1600 when no scale is given."""

    test_every: int | None = None
    """Hold out every Nth photograph, in name order from the first on: not trained on, used to measure; 0 holds out
    none. Default: 8; 0 for recipe:surface, its variants and recipe:stereo, and where depth maps are prepared. A data
    set with test photographs of its own holds out those."""

    test_list: Path | None = None
    """Hold out the photographs named in this file instead: one name per line, relative to images/."""

    images: Path | None = None
    """Folder of the photographs, when it is not images/; relative to the data set."""

    missing: Literal["refuse", "skip"] = "refuse"
    """What to do where photographs of the model are not there: refuse the data set, or skip them and use the others."""

    masks: Path | None = None
    """Folder of the masks, if it is not called masks; relative to the data set. Black pixels are ignored."""

    layout: str | None = None
    """Layout of the data set, such as colmap (`surfkit components reader` lists them); recognised if left out."""

    white: bool = False
    """Composite transparent pixels of photographs over white instead of black."""

    alpha: Alpha | None = None
    """What becomes of transparent pixels of photographs: mask ignores them in training and in the metrics, blend
    composites them over black (or white, with --white), ignore takes their colours as stored. Default: blend, but
    ignore where a fourth band of a TIFF file is no opacity."""

    metres_per_unit: float | None = None
    """Metres per unit of the data set's coordinates, if the data set does not state it. Settings in metres need it."""

    model: Path | None = None
    """Folder of the COLMAP model, such as sparse/1, where there are several; the one with most photographs by
    default."""

    split: Annotated[Split | None, choice(Split, optional=True)] = None
    """Rule of which photographs are held out, such as gauu-scene, instead of --test-every."""

    depth_layout: Annotated[DepthLayout | None, choice(DepthLayout, optional=True)] = None
    """Layout of the data set's depth maps, such as nerfstudio-depths; recognised if left out."""

    depth_of: Literal["distorted", "undistorted"] | None = None
    """Of which photographs the data set's depth maps are, where lenses distort and the shape of a map fits both.
    Default: by the sparse points, and of the distorted ones where these do not tell."""

    test_data: Path | None = None
    """Another data set, of the same layout and in the same coordinates, whose photographs are all held out: the test
    folder of MatrixCity as CityGaussian prepares it."""

    def __post_init__(self) -> None:
        if self.scale is not None and not 1 <= self.scale < float("inf"):
            raise BadInput(f"--scale {self.scale:g}: it divides the size, so it must be 1 or more")
        if self.longest is not None and self.longest < 1:
            raise BadInput(f"--longest {self.longest}: it is the longest side in pixels, so it must be 1 or more")
        if sum(given is not None for given in (self.split, self.test_list, self.test_data)) > 1:
            raise BadInput("--split, --test-list and --test-data each choose what is held out; give one")
        if self.white and self.alpha not in (None, "blend"):
            raise BadInput(f"--white blends transparent pixels, and --alpha {self.alpha} does not; give one")
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < float("inf"):
            raise BadInput(f"--metres-per-unit {self.metres_per_unit:g}: it must be more than 0")
        if self.test_every is not None and self.test_every < 0:
            raise BadInput(f"--test-every {self.test_every}: it must be 0 (hold out none) or more")

    def lack(self, folder: Path, missing: Sequence[str], count: int, remedy: str = "") -> None:
        """Tell of photographs that are missing, where they are skipped; else, or if it is all of them, reject them.

        Args:
            folder: Where they should be.
            missing: Their names; none is fine.
            count: Of all photographs of the model.
            remedy: What to do instead of skipping them, to follow the names.
        """
        if not missing:
            return
        text = f"{folder}: {len(missing)} of {count} photographs are missing"
        if self.missing == "skip" and len(missing) < count:
            emit(Warned(f"{text} and are skipped: {few(missing)}"))
        else:
            skip = "; --missing skip uses the others" if len(missing) < count else ""
            reject(BadInput(f"{text}: {few(missing)}{remedy}{skip}"))

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height to use, for a photograph of `width` x `height` pixels; never larger than it is."""
        longest = self.longest or (DEFAULT_LONGEST_PX if self.scale is None else max(width, height))
        by = max(self.scale or 1.0, max(width, height) / longest)
        return max(1, round(width / by)), max(1, round(height / by))

    def of(self, path: Path, test_every: int = TEST_EVERY) -> Data:
        """The data set at `path`, read so; every so many-th photograph is held out if nobody has said which."""
        given = {each.name: getattr(self, each.name) for each in fields(ReadSettings)}
        return Data(path, **{"test_every": test_every} | {name: it for name, it in given.items() if it is not None})


@dataclass(frozen=True)
class Data(ReadSettings):
    """A data set and how it is read."""

    path: Annotated[Path, tyro.conf.arg(name="data")]
    """Folder of the data set: images/ and a COLMAP model in sparse/0, sparse, colmap/sparse/0 or colmap/sparse, or
    another layout that `surfkit components reader` lists."""

    test_every: int = field(default=TEST_EVERY, kw_only=True)
    """Hold out every Nth photograph, in name order from the first on, unless another rule is given; 0 for none."""

    priors: Annotated[Path | None, tyro.conf.Suppress] = None
    """Folder of the depth maps that a run made for it, where it has none of its own."""

    def moved(self, path: Path) -> Data:
        """The same data set, which is at `path` now, with all that lies in it."""
        named = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "path"}
        inside: dict[str, Any] = {
            name: path / it.relative_to(self.path)
            for name, it in named.items()
            if isinstance(it, Path) and it.is_relative_to(self.path)
        }
        return replace(self, path=path, **inside)

    def held_out(self, capture: RawDataset) -> set[str]:
        """Names of the photographs that are held out: not trained on, kept to measure with.

        Raises:
            BadInput: All of them, or some that are not there.
        """
        names = [shot.name for shot in capture.shots]
        if self.split is not None:
            chosen, rule = self._by_rule(self.split, capture)
        elif self.test_list is not None:
            chosen, rule = _listed(self.test_list, names), f"--test-list {self.test_list}"
        elif capture.held_out is not None:
            chosen, rule = set(capture.held_out), "the data set's own split"
        else:
            chosen = set(sorted(names)[:: self.test_every]) if self.test_every else set()
            rule = f"--test-every {self.test_every}"
        if len(chosen) == len(names):
            what = f"all {len(names)} photographs" if len(names) > 1 else "the only photograph"
            raise BadInput(f"{rule} holds out {what}; use --test-every 0 to hold out none")
        return chosen

    def _by_rule(self, split: Split, capture: RawDataset) -> tuple[set[str], str]:
        """What a split holds out, and how the user chose it."""
        rule = f"--split {name_of(split)}"
        try:
            chosen = set(split.held_out(capture))
        except BadInput as error:
            raise BadInput(f"{rule}: {error}") from error
        if unknown := chosen - {shot.name for shot in capture.shots}:
            raise BadInput(f"{rule} holds out {min(unknown)!r}, which is no photograph of the data set")
        return chosen, rule


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
    slashes = {name.replace("\\", "/"): name for name in names}
    chosen = {name if name in names else slashes.get(name.replace("\\", "/"), name) for name in chosen}
    for name in sorted(chosen - set(names)):
        raise BadInput(f"--test-list {path}: no photograph {name!r} in the model{nearest(name, names)}")
    return chosen


def _reason(error: OSError | UnicodeDecodeError) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else "it is not UTF-8"
