"""Depth maps of stereo whose holes are filled, with a confidence that says so."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.files import replacing
from surfkit.core.registry import choice, name_of
from surfkit.depth.base import DepthEstimator, DepthInput, Estimate
from surfkit.depth.fill_base import SEEN_THROUGH, Fill, FillInput
from surfkit.depth.fill_planes import PlaneFill
from surfkit.depth.neighbours import MAX_CANDIDATE_VIEWS, neighbours
from surfkit.depth.patch_match import PatchMatch
from surfkit.io.datasets.depth_files import NORMAL_SCALE
from surfkit.scene.arrays import write_array
from surfkit.scene.camera import Camera
from surfkit.scene.photos import read_photo
from surfkit.scene.scene import View
from surfkit.scene.vectors import unit

MAX_CACHED_MAPS = 64
"""Maps of stereo that are kept in memory."""
MIN_TOLD_SHARE = 0.05
"""Share of the pixels left empty from which on a reason is told."""
FILL_VERSION = 2
"""Raised when the same settings fill otherwise."""


@dataclass(frozen=True)
class Filled(DepthEstimator):
    """Depth maps of another estimator whose holes are filled, as MetroGS (CVPR 2026) does.

    Holes are the pixels that it trusts less than `sure`. What fills them must agree with the trusted pixels beside
    them, as `fill` says, and is left out where more views see through it than see a surface there. Filled pixels have
    a confidence of `trust`: the depth loss weighs them by it, `start:stereo` begins there too, and nothing takes them
    for what stereo knows.
    """

    aligned: ClassVar[bool] = True

    stereo: Annotated[DepthEstimator, choice(DepthEstimator, without=("filled",))] = field(default_factory=PatchMatch)
    """The estimator of the maps; one that compares photographs, whose depth is in the units of the scene."""

    fill: Annotated[Fill, choice(Fill)] = field(default_factory=PlaneFill)
    """What fills the holes."""

    trust: float = 0.3
    """Confidence of filled pixels. `start:stereo` uses pixels from 0.25 on, and takes those from 0.375 on for what is
    seen."""

    sure: float = 0.375
    """Least confidence of a pixel that is trusted: no hole, and what a fill is aligned to."""

    neighbours: int = 12
    """Photographs whose trusted depth tells what is free, for each photograph."""

    def __post_init__(self) -> None:
        if not self.stereo.aligned or isinstance(self.stereo, Filled):
            raise BadInput(
                f"stereo is {name_of(self.stereo)}, whose depth is not in the units of the scene: give an estimator "
                "that compares photographs, such as patch-match or plane-sweep"
            )
        if not 0 < self.trust < self.sure <= 1:
            raise BadInput(
                f"trust is {self.trust:g} and sure {self.sure:g}; give a trust above 0 and below sure, and a sure of "
                "at most 1"
            )
        if not 1 <= self.neighbours <= MAX_CANDIDATE_VIEWS:
            raise BadInput(f"neighbours is {self.neighbours}; it must be 1 to {MAX_CANDIDATE_VIEWS}")

    @property
    def matched(self) -> bool:  # type: ignore[override]  # as its stereo is
        """See `DepthEstimator`."""
        return self.stereo.matched

    @property
    def oriented(self) -> bool:  # type: ignore[override]  # likewise
        """See `DepthEstimator`."""
        return self.stereo.oriented

    @property
    def continues(self) -> bool:  # type: ignore[override]  # likewise
        """See `DepthEstimator`."""
        return self.stereo.continues

    @property
    def version(self) -> int:  # type: ignore[override]  # of both
        """See `DepthEstimator`."""
        return 1000 * FILL_VERSION + self.stereo.version

    def of_map(self, camera: Camera) -> Camera:
        """See `DepthEstimator.of_map`."""
        return self.stereo.of_map(camera)

    def files(self, views: Sequence[View]) -> tuple[Path, ...]:
        """See `DepthEstimator.files`."""
        return (*self.stereo.files(views), *self.fill.files(views))

    def refuse_unfit(self, views: Sequence[View]) -> None:
        """See `DepthEstimator.refuse_unfit`."""
        self.stereo.refuse_unfit(views)

    def refuse_missing(self) -> None:
        """See `DepthEstimator.refuse_missing`."""
        self.stereo.refuse_missing()
        self.fill.refuse_missing()

    def notice(self) -> str | None:
        """See `DepthEstimator.notice`."""
        return "; ".join(filter(None, (self.stereo.notice(), self.fill.notice()))) or None

    def estimate(self, given: DepthInput, wanted: Sequence[int]) -> Iterator[Estimate]:
        fill = self.fill.opened(given, wanted)  # before hours of stereo: it may refuse
        near = neighbours(given.views, given.observations, self.neighbours, PatchMatch.angle)
        needed = sorted({*wanted, *(other for at in wanted for other in near[at])})
        missing = [at for at in needed if not stereo_path(given, at).exists()]
        for found in self.stereo.estimate(replace(given, work=given.work / "stereo"), missing) if missing else ():
            save_estimate(stereo_path(given, found.at), found)

        @lru_cache(MAX_CACHED_MAPS)
        def trusted(at: int) -> tuple[Camera, torch.Tensor] | None:
            found = load_estimate(stereo_path(given, at), at)
            if found.inverse is None or found.confidence is None:
                return None
            height, width = found.inverse.shape
            sure = (found.inverse > 0) & (found.confidence >= self.sure)
            return given.views[at].camera.resized(width, height), torch.where(sure, found.inverse, 0)

        pixels, filled, empty, reasons = 0, 0, 0, Counter[str]()

        def tell(why: str, count: int) -> None:
            reasons[why] += count

        for at in wanted:
            found, own = load_estimate(stereo_path(given, at), at), trusted(at)
            if own is None or found.inverse is None or found.confidence is None:
                yield found
                continue
            camera, inverse = own
            photo, view = None, given.views[at]
            with suppress(BadInput):  # a damaged photograph: stereo passes over it too, and tells
                photo = read_photo(view.path, (camera.width, camera.height), pixels=view.pixels).float() / 255
            if photo is None:
                yield found
                continue
            others = [other for other in map(trusted, near[at]) if other is not None]
            hole = FillInput(at, photo, camera, inverse, torch.where(inverse > 0, found.confidence, 0), others, tell)
            values = torch.where(hole.holes, fill(hole), 0)
            free = hole.is_free(values)
            tell(SEEN_THROUGH, int(free.sum()))
            values = torch.where(free, 0, values)
            there = values > 0
            pixels, filled = pixels + there.numel(), filled + int(there.sum())
            empty += int((hole.holes & ~there).sum())
            normal = None if found.normal is None else torch.where(there, 0, found.normal)
            yield Estimate(
                at,
                torch.where(there, values, found.inverse),
                torch.where(there, self.trust, found.confidence),
                normal,
            )
        if pixels:
            why = shares_of(reasons, empty)
            emit(Warned(f"fill: {filled / pixels:.0%} of the pixels filled, {empty / pixels:.0%} left empty{why}"))


def shares_of(reasons: Counter[str], empty: int) -> str:
    """Why pixels are left empty, the most frequent reasons first; nothing if nobody told.

    Args:
        reasons: How many pixels each is the reason of.
        empty: Pixels that are left empty.
    """
    told = [f"{why} ({count / empty:.0%})" for why, count in reasons.most_common() if count >= MIN_TOLD_SHARE * empty]
    return f", because {'; '.join(told)}" if told and empty else ""


def stereo_path(given: DepthInput, at: int) -> Path:
    """Where the map of stereo is kept until all are filled."""
    return given.work / "maps" / f"{at:06d}.stereo"


def save_estimate(path: Path, found: Estimate) -> None:
    """Write an estimate, or that there is none, into a file: arrays as `write_map` keeps them, or nothing."""
    with replacing(path) as file:
        if found.inverse is not None and found.confidence is not None:
            write_array(file, found.inverse.numpy())
            write_array(file, (found.confidence * 255).round().to(torch.uint8).numpy())
            if found.normal is not None:
                write_array(file, (found.normal * NORMAL_SCALE).round().to(torch.int8).numpy())


def load_estimate(path: Path, at: int) -> Estimate:
    """What `save_estimate` wrote of the view at a position."""
    size = path.stat().st_size
    if not size:
        return Estimate(at, None, None)
    with path.open("rb") as file:
        inverse, confidence = torch.from_numpy(np.load(file)), torch.from_numpy(np.load(file)).float() / 255
        normal = unit(torch.from_numpy(np.load(file)).float()) if file.tell() < size else None
    return Estimate(at, inverse, confidence, normal)
