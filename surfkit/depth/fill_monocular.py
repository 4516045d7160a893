"""Holes of depth maps filled with monocular depth, aligned patch by patch to trusted stereo (MetroGS, CVPR 2026)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput, require_within
from surfkit.core.events import Warned, emit
from surfkit.core.registry import choice
from surfkit.depth.base import DepthEstimator, DepthInput
from surfkit.depth.depth_anything import DepthAnythingV2
from surfkit.depth.fill_base import MIN_FITTING_SHARE, Fill, FillInput
from surfkit.io.datasets.depth_files import DepthFile
from surfkit.io.datasets.depth_layout import DepthQuery, find_maps
from surfkit.io.datasets.depth_lens import lens_in, refuse_unlike
from surfkit.io.datasets.depth_prior import list_reasons
from surfkit.io.datasets.depth_sampling import resized, straightened
from surfkit.scene.scene import View

MIN_SUPPORTS = 20
"""Fewer trusted pixels tell neither scale nor shift."""
MIN_BLENDED_SHARE = 0.5
"""Share of the weights of the patches around a pixel that patches must have which fit."""
MIN_RAISED_SHARE = 0.1
"""Values of a map that has some below 0 are raised to this share of their range."""
ABSOLUTE_PASSES, CAUCHY_PASSES = 15, 5
"""Passes of iteratively reweighted least squares: for the least absolute error, then for that of Cauchy."""
CAUCHY_SCALE = 2.385 * 1.4826
"""In medians of the absolute error; 95 % efficient for normal errors (Holland and Welsch 1977)."""
BEYOND_RANGE = "their depth lies beyond that of the trusted pixels around them"
DISAGREEING = "the patches around them do not agree"
NO_VALUE = "the maps have no value there"
MONOCULAR_FILL_RANGES = {"patch": (0.01, 2), "support": (1e-6, 1), "tolerance": (1e-6, 1)}


@dataclass(frozen=True)
class MonocularFill(Fill):
    """Relative inverse depth of single photographs, with a scale and a shift for each patch, blended between patches.

    Scale and shift are fitted to the trusted pixels of a patch, robustly and weighted by their confidence. A patch is
    left out with too few of them, where they do not fit, and where nearer is farther. Pixels are filled only as far as
    monocular depth lies in the range of the trusted pixels, and where the patches around them agree.

    MetroGS (arXiv 2511.19172) aligns patch by patch too; sizes, fit, blend and what is left out are of our own.
    """

    maps: str = ""
    """Folder of maps that any network made, in one of the layouts of depth maps, such as estimated_depths/NAME.npy of
    relative inverse depth; the network of `network` if empty."""

    network: Annotated[DepthEstimator, choice(DepthEstimator, without=("filled",))] = field(
        default_factory=DepthAnythingV2
    )
    """What makes the maps if `maps` names none."""

    patch: float = 0.2
    """Side of a patch, as a share of the longest side of the photograph; patches overlap by half of it."""

    support: float = 0.1
    """Least share of the pixels of a patch that stereo must trust."""

    tolerance: float = 0.015
    """Largest error of the fit, as a share of the inverse depth, for four fifths of the trusted pixels of a patch."""

    def __post_init__(self) -> None:
        require_within(MONOCULAR_FILL_RANGES, self)

    def refuse_missing(self) -> None:
        """See `Fill.refuse_missing`."""
        if not self.maps:
            self.network.refuse_missing()
        elif not Path(self.maps).is_dir():
            raise BadInput(
                f"fill.maps is {self.maps}, which is no folder; name one with a depth map of each photograph"
            )

    def notice(self) -> str | None:
        """See `Fill.notice`."""
        return None if self.maps else self.network.notice()

    def files(self, views: Sequence[View]) -> tuple[Path, ...]:
        """See `Fill.files`."""
        return tuple(file.path for file in self.found(views).values()) if self.maps else self.network.files(views)

    def found(self, views: Sequence[View]) -> dict[str, DepthFile]:
        """The maps in the folder, by name of the photograph.

        Raises:
            BadInput: There are none.
        """
        self.refuse_missing()
        files = find_maps(DepthQuery(Path(self.maps), [view.name for view in views], Path(self.maps)))
        if views and not files:
            raise BadInput(
                f"fill.maps is {self.maps}, which has no depth map of these photographs; name the folder of a data "
                f"set, or one with estimated_depths/{views[0].name}.npy"
            )
        return files

    def opened(self, given: DepthInput, wanted: Sequence[int]) -> Callable[[FillInput], Tensor]:
        """See `Fill.opened`."""
        of_view = self.from_files(given, wanted) if self.maps else self.from_network(given, wanted)

        def fill(hole: FillInput) -> Tensor:
            values = of_view(hole.at)
            if values is None:
                return torch.zeros_like(hole.inverse)
            size = (hole.inverse.shape[0], hole.inverse.shape[1])
            return torch.from_numpy(self.aligned(resized(values, size).numpy(), hole))

        return fill

    def from_files(self, given: DepthInput, wanted: Sequence[int]) -> Callable[[int], Tensor | None]:
        """(h, w) values of the view at a position, 0 where there are none, from its file; None without one."""
        views = [given.views[at] for at in wanted]
        files = self.found(given.views)
        with ThreadPoolExecutor(4) as pool:
            read = pool.map(lambda view: fault_in(view, files.get(view.name)), views)
            faults = {view.name: fault for view, fault in zip(views, read, strict=True) if fault}
        if faults and len(faults) == len(views):
            raise BadInput(
                f"fill.maps is {self.maps}, of which no map can be used: {list_reasons(faults)}; give maps of inverse "
                "depth of these photographs"
            )
        if faults:
            emit(Warned(f"fill.maps: {len(faults)} of {len(views)} photographs are not filled: {list_reasons(faults)}"))
        return lambda at: None if (view := given.views[at]).name in faults else read_map(view, files[view.name])

    def from_network(self, given: DepthInput, wanted: Sequence[int]) -> Callable[[int], Tensor | None]:
        """The same from the network, which is asked for all views at once."""
        estimates, early = iter(self.network.estimate(given, wanted)), dict[int, Tensor | None]()

        def next_of(at: int) -> Tensor | None:
            while at not in early:
                estimate = next(estimates)
                early[estimate.at] = estimate.inverse
            return early.pop(at)

        return next_of

    def aligned(self, values: np.ndarray, hole: FillInput) -> np.ndarray:
        """(h, w) float32 inverse depth of monocular values (h, w), 0 where they are not to be used.

        A patch has the weight of a tent over it, so that those of all patches add up to 1 everywhere.
        """
        height, width = values.shape
        step = max(2.0, self.patch * max(height, width) / 2)
        inverse, trust = hole.inverse.numpy(), hole.trust.numpy()
        total, mean, square = (np.zeros(values.shape) for _ in range(3))
        reasons = _Reasons(values.shape)
        for y in range(math.ceil((height - 1) / step) + 1):
            for x in range(math.ceil((width - 1) / step) + 1):
                rows, row_weight = tent(y * step, step, height)
                columns, column_weight = tent(x * step, step, width)
                part, weight = (rows, columns), row_weight[:, None] * column_weight
                found = self.fitted(values[part], inverse[part], trust[part])
                if isinstance(found, str):
                    reasons.add(found, part, weight)
                else:
                    reasons.add(BEYOND_RANGE, part, weight * (found <= 0))
                    weight = weight * (found > 0)
                    total[part] += weight
                    mean[part] += weight * found
                    square[part] += weight * found**2
        with np.errstate(divide="ignore", invalid="ignore"):
            mean, spread = mean / total, np.sqrt(np.maximum(square / total - (mean / total) ** 2, 0))
            many = total >= MIN_BLENDED_SHARE
            keep = many & (spread <= self.tolerance * mean)
        reasons.add(DISAGREEING, (slice(None), slice(None)), np.where(many & ~keep, math.inf, 0.0))
        reasons.add(NO_VALUE, (slice(None), slice(None)), np.where(values <= 0, math.inf, 0.0))
        reasons.tell(hole, (inverse <= 0) & ~keep)
        return np.where(keep, mean, 0).astype(np.float32)

    def fitted(self, values: np.ndarray, inverse: np.ndarray, trust: np.ndarray) -> np.ndarray | str:
        """(h, w) inverse depth of a patch, 0 where it goes beyond what the patch tells; why, if it tells nothing.

        Args:
            values: (h, w) monocular values; 0 where there are none.
            inverse: (h, w) trusted inverse depth; 0 elsewhere.
            trust: (h, w) confidence of that.
        """
        known = (inverse > 0) & (values > 0)
        if known.sum() < max(MIN_SUPPORTS, self.support * known.size):
            return f"stereo trusts too little around them, less than {self.support:.0%} of a patch"
        c = inverse[known].astype(np.float64)
        scale, shift = robust_line(values[known].astype(np.float64), c, trust[known].astype(np.float64))
        aligned = scale * values.astype(np.float64) + shift
        fits = np.abs(aligned[known] - c) <= self.tolerance * c
        if scale == 0 or np.average(fits, weights=trust[known]) < MIN_FITTING_SHARE:
            return f"the maps do not fit trusted stereo there to {self.tolerance:.1%}"
        if scale < 0:
            return "nearer pixels have lower values in the maps there, as in maps of depth: give maps of inverse depth"
        low, high = aligned[known][fits].min(), aligned[known][fits].max()
        reached = (aligned >= low * (1 - self.tolerance)) & (aligned <= high * (1 + self.tolerance))
        return np.where((values > 0) & reached & (aligned > 0), aligned, 0)


class _Reasons:
    """Why pixels of a map (h, w) are not filled: of each pixel what weighs most."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.names: list[str] = []
        self.weight, self.name = np.zeros(shape), np.zeros(shape, np.int64)

    def add(self, why: str, part: tuple[slice, slice], weight: np.ndarray) -> None:
        """Something that speaks against the pixels of a part with a weight above 0."""
        if why not in self.names:
            self.names.append(why)
        heavier = (weight > self.weight[part]) | (weight == math.inf)
        self.weight[part][heavier] = weight[heavier]
        self.name[part][heavier] = self.names.index(why)

    def tell(self, hole: FillInput, empty: np.ndarray) -> None:
        """Count the reasons of the pixels that stay empty, (h, w) bool."""
        for at, count in enumerate(np.bincount(self.name[empty], minlength=len(self.names))):
            if count:
                hole.tell(self.names[at], int(count))


def fault_in(view: View, file: DepthFile | None) -> str:
    """Why the map of a view cannot be used; empty if it can."""
    if file is None:
        return "no map"
    try:
        values = file.read()
        refuse_unlike(values, view, lens_in(view, file, values.shape, straight=False))
    except BadInput as error:
        return str(error).removeprefix(f"{file.path}: ")
    return ""


def read_map(view: View, file: DepthFile) -> Tensor:
    """(h, w) values of a map, undistorted with its photograph, above 0; 0 where there are none."""
    try:
        values = torch.from_numpy(file.read())
    except BadInput as error:
        raise BadInput(f"{file.path}: {error}") from error
    known = values.isfinite()
    if known.any() and (low := values[known].min()) <= 0:  # they have any shift
        values = values - low + MIN_RAISED_SHARE * (values[known].max() - low)
    values = torch.where(known, values, 0)
    lens = lens_in(view, file, values.shape, straight=False)
    return values if lens is None else straightened(values, lens)


def tent(middle: float, reach: float, size: int) -> tuple[slice, np.ndarray]:
    """Positions, of 0 to `size` - 1, less than `reach` away from a middle, and their weights, which fall to 0 there."""
    first, last = max(0, math.floor(middle - reach) + 1), min(size - 1, math.ceil(middle + reach) - 1)
    return slice(first, last + 1), 1 - np.abs(np.arange(first, last + 1) - middle) / reach


def robust_line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Scale and shift of the line y = scale * x + shift, by iteratively reweighted least squares.

    First for the least sum of absolute errors, which begins nowhere wrong, then with the weights of Cauchy. The scale
    is 0 where all x are the same.

    Args:
        x, y, weight: (K,) each.
    """
    tiny, now = 1e-9 * np.abs(y).mean() + 1e-300, weight
    scale, shift = 0.0, float(np.average(y, weights=weight))
    for index in range(ABSOLUTE_PASSES + CAUCHY_PASSES):
        at, to = np.average(x, weights=now), np.average(y, weights=now)
        across = np.average((x - at) ** 2, weights=now)
        scale = float(np.average((x - at) * (y - to), weights=now) / across) if across > 1e-14 * at**2 else 0.0
        shift = float(to - scale * at)
        error = np.abs(y - scale * x - shift)
        if index < ABSOLUTE_PASSES:
            now = weight / np.maximum(error, tiny)
        else:
            now = weight / (1 + (error / (CAUCHY_SCALE * np.median(error) + tiny)) ** 2)
    return scale, shift
