"""Stereo with a slanted plane for every pixel, compiled."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from surfkit.core.check import BadInput, require_within
from surfkit.core.events import Progress, emit
from surfkit.depth.base import DepthEstimator, DepthInput, Estimate
from surfkit.depth.consistency import agreement, at_edge
from surfkit.depth.cuda.passes import GpuPasses
from surfkit.depth.native_patch_match import GreyImage, MatchingSettings, Planes, improve, parallax_of, require_native
from surfkit.depth.neighbours import depth_range, in_turn, neighbours
from surfkit.depth.photo_light import EvenLight, stretched
from surfkit.depth.plane_map import PlaneMap, inverse_of, load_map, save_map
from surfkit.depth.plane_sweep import PlaneSweep, refuse_wide_window
from surfkit.scene.camera import Camera
from surfkit.scene.photos import read_photo
from surfkit.scene.scene import View

MAX_CACHED_PICTURES = 48
"""Pictures and maps kept in memory, if they take no more than `MAX_CACHED_BYTES`; those that one is compared with in
any case."""
MAX_CACHED_BYTES, PICTURE_PIXEL_BYTES, DEPTH_PIXEL_BYTES = 2 << 30, 6, 4
"""Of a pixel: twice as many photographs, and pictures as they are compared, of all sizes; and the depth map of each
round."""
JITTER_PX = 0.5
"""Parallax by which planes are changed at random in the last pass at a size; twice as much in each one before."""
LAST_JITTER_PX = 0.25
"""Of the pass that compares depth maps."""
COARSE_WINDOW_PIXELS, FULL_WINDOW_PIXELS = 16, 32
"""Pixels of a window that are compared at first, and from the last photometric pass at full size on."""
MATCHING_PHASE, COMPARING_PHASE = "matching photographs", "comparing depth maps"
"""What is done while the maps of the first round are made, and those of the others."""
PATCH_MATCH_RANGES = {
    "longest": (32, 20_000),
    "scale": (1, 1000),
    "neighbours": (1, 16),
    "angle": (0.01, 180),
    "best": (1, 16),
    "window": (3, 17),
    "spread": (1e-4, 100),
    "smoothness": (0, 1000),
    "brightness": (0, 1000),
    "passes": (1, 8),
    "consistency": (0, 1000),
    "rounds": (1, 8),
    "coarsest": (32, 1000),
    "tolerance_px": (1e-6, 1000),
    "agree": (1, 16),
}
"""Of the settings: what is larger only costs time, or is the same as no limit."""


@dataclass(frozen=True)
class PatchMatch(DepthEstimator):
    """PatchMatch stereo (Bleyer et al. 2011): each pixel has a slanted plane, improved by the planes of other pixels.

    Planes begin with a plane sweep of small pictures and are improved from coarse to fine by photometric consistency,
    in the views that match best at each pixel; then also by the reprojection error in the depth maps of other
    views (Xu and Tao 2019). Before, exposure, white balance and vignetting of the photographs are evened out by the
    sparse points that they share. The time is linear in the number of pixels. Needs the compiled part of surfkit; on a
    GPU, planes are tried there.
    """

    aligned: ClassVar[bool] = True
    matched: ClassVar[bool] = True
    oriented: ClassVar[bool] = True
    continues: ClassVar[bool] = True
    version: ClassVar[int] = 11

    longest: int = 1600
    """Longest side of a depth map in pixels; never more than that of the photograph."""

    scale: float = 1.0
    """How many times smaller than its photograph a depth map is; `longest` may make it smaller still. Half the size (2)
    takes a third to a quarter of the time, and is for a first look."""

    neighbours: int = 16
    """Source photographs for each photograph. A pixel is matched in the `best` of them, so more cost little and help
    where few show a place."""

    angle: float = 12.0
    """Preferred angle between the rays of two photographs, degrees: a smaller one gives less parallax, at a larger one
    they look different."""

    best: int = 2
    """Source photographs that a plane is scored by: those that match best, out of twice as many that match best at the
    pixel and around it. Of these, one that matches much worse than the best counts little. Three take 1.15 times as
    long and trust fewer pixels, which are more often right; that helps in photographs from the ground."""

    window: int = 7
    """Side of the matching window, pixels; odd. Smaller windows keep edges sharp, larger ones are less sensitive to
    noise."""

    spread: float = 0.06
    """Difference of grey values, in [0, 1], at which the weight of a pixel of the window falls to 1 / e: windows end at
    image edges."""

    brightness: float = 1.5
    """Cost of a difference of brightness between a window and what another photograph shows, as a share of both, up to
    half of the cost of a wrong match. Photographs are made equally bright before. Windows without texture look alike
    otherwise, on roofs and in shadow. At a high cost planes follow noise, and are rougher. 0 turns this off."""

    smoothness: float = 0.015
    """Cost of a difference of one pixel of parallax between the planes of neighbouring pixels of one grey value; 1 is
    the cost of a wrong match. It grows where a window shows little contrast."""

    passes: int = 4
    """Passes over the pixels at the smallest image size, and one less at the larger sizes; at full size, where depth
    maps are compared too, two less, but at least one."""

    consistency: float = 0.2
    """Cost of one pixel of reprojection error in the depth maps of the source photographs; 0 turns this comparison
    off."""

    rounds: int = 2
    """Comparisons of depth maps, each with those of the one before; none if `consistency` is 0."""

    coarsest: int = 80
    """Longest side of the smallest images, where the planes are initialised, pixels."""

    tolerance_px: float = 1.0
    """Largest reprojection error, pixels, at which the depth maps of two photographs agree."""

    agree: int = 3
    """Photographs whose depth maps must agree for full confidence; all of them where fewer show the place."""

    edge: float = 0.01
    """Relative jump in depth that makes an edge; the nearer side of an edge gets no confidence, as matching widens
    it."""

    def __post_init__(self) -> None:
        require_within(PATCH_MATCH_RANGES, self)
        if self.window % 2 == 0:
            raise BadInput(f"window is {self.window}; it must be an odd number of pixels, so that it has a middle")
        if self.best > self.neighbours:
            raise BadInput(f"best is {self.best}; it must be no more than neighbours, {self.neighbours}")
        if not 0 < self.edge < 1:
            raise BadInput(f"edge is {self.edge:g}; it must lie between 0 and 1")

    def refuse_missing(self) -> None:
        """See `DepthEstimator.refuse_missing`."""
        require_native()

    def refuse_unfit(self, views: Sequence[View]) -> None:
        """See `DepthEstimator.refuse_unfit`."""
        require_native()
        refuse_wide_window(self.window, {view.name: self.of_map(view.camera) for view in views})

    def of_map(self, camera: Camera) -> Camera:
        """See `DepthEstimator.of_map`."""
        return camera.fitted(min(self.longest, max(1, round(max(camera.width, camera.height) / self.scale))))

    def estimate(self, given: DepthInput, wanted: Sequence[int]) -> Iterator[Estimate]:
        pairs = neighbours(given.views, given.observations, self.neighbours, self.angle)
        work = PatchMatchWorkspace(self, given, pairs, wanted)
        for at in in_turn(pairs, wanted):
            found = work.last.map(at)
            yield Estimate(at, None, None) if found is None else self.trusted(work, at, found)
            work.finish(at)

    def trusted(self, work: PatchMatchWorkspace, at: int, found: PlaneMap) -> Estimate:
        """What the maps of other photographs agree with, and the mean of what they say."""
        camera = work.camera(at, 0)
        depths = ((near, work.last.depth(near)) for near in work.pairs[at])
        others = [(work.camera(near, 0), depth) for near, depth in depths if depth is not None]
        share = self.tolerance_px / found.parallax / float(found.inverse[found.inverse > 0].median())
        inverse = found.inverse.to(work.given.device)
        said = agreement(camera, inverse, others, share)
        trust = said.trust(self.agree).cpu() * found.matched(self.best)
        trust[at_edge(inverse, self.window // 2, self.edge).cpu()] = 0
        return Estimate(at, said.fused.cpu(), trust, found.normals(camera))


@dataclass(frozen=True)
class InitialPlaneSweep(PlaneSweep):
    """The sweep in which planes begin; it also looks for what is nearer or further than all sparse points."""

    margin: float = 0.5

    def remedy(self, longest: int) -> str:
        """See `PlaneSweep.remedy`."""
        return f"give a lower coarsest, of {longest} or less"


class DepthMapRound(NamedTuple):
    """Maps of a data set, made when they are asked for.

    Attributes:
        what: What is done while they are made.
        map: Of the view at a position, or None where none can be made.
        depth: (H, W) inverse depth alone, a seventh of the whole, on the device of the estimator.
        made: Positions of those that were made, or are not needed.
    """

    what: str
    map: Callable[[int], PlaneMap | None]
    depth: Callable[[int], Tensor | None]
    made: set[int]


class PatchMatchWorkspace:
    """Pictures and maps of a data set.

    Maps are kept in the folder for work as long as they are needed: they are ten times as large as what comes of them.
    Those of the first of the `rounds` are made by photometric consistency alone, the others by geometric consistency
    with those of the round before too.
    """

    def __init__(self, settings: PatchMatch, given: DepthInput, pairs: list[list[int]], wanted: Sequence[int]) -> None:
        self.settings, self.given, self.pairs, self.wanted = settings, given, pairs, set(wanted)
        self.users: list[list[int]] = [[at] for at in range(len(pairs))]  # each photograph, and those compared with it
        for at, others in enumerate(pairs):
            for other in others:
                self.users[other].append(at)
        self.sweep = InitialPlaneSweep(longest=settings.coarsest)
        self.improve = GpuPasses(given.device).improve if given.device.type == "cuda" else improve
        kept, every = self.room(), range(len(pairs))
        self.light = EvenLight(given)
        self.small = lru_cache(MAX_CACHED_PICTURES)(lambda at: self.light.picture(self.sweep.picture(given, at), at))
        self.value = lru_cache(2 * kept)(self.read)
        self.greys = [
            lru_cache(kept)(partial(self.halved, level)) for level in range(1 + max(map(self.levels, every), default=0))
        ]
        self.rounds = [self.round(MATCHING_PHASE, self.match, kept)]
        for index in range(1, self.number_of_rounds):
            again, before = f", round {index}" if index > 1 else "", self.rounds[-1]
            self.rounds.append(self.round(COMPARING_PHASE + again, partial(self.reconcile, before=before), kept))
        self.last = self.rounds[-1]
        for each in reversed(self.rounds):
            each.made.update(at for at in every if self.path(each.what, at).exists() or not self.is_needed(each, at))

    @property
    def number_of_rounds(self) -> int:
        """With the one by photometric consistency alone."""
        return 1 + self.settings.rounds if self.settings.consistency else 1

    def round(self, what: str, make: Callable[[int], PlaneMap | None], kept: int) -> DepthMapRound:
        """Of maps that `make` makes, if they are not in the folder for work yet."""
        made: set[int] = set()
        found = lru_cache(1)(lambda at: self.kept(what, at, make, made))
        return DepthMapRound(what, found, lru_cache(kept)(lambda at: inverse_of(found(at), self.given.device)), made)

    def room(self) -> int:
        """How many pictures and maps are kept in memory."""
        pixels = max((c.width * c.height for c in (self.camera(at, 0) for at in range(len(self.pairs)))), default=1)
        most = min(
            MAX_CACHED_PICTURES,
            MAX_CACHED_BYTES // ((PICTURE_PIXEL_BYTES + DEPTH_PIXEL_BYTES * self.number_of_rounds) * pixels),
        )
        return max(most, 2 + max(map(len, self.pairs), default=0))

    def camera(self, at: int, level: int) -> Camera:
        """Of a photograph whose sides are halved `level` times."""
        whole = self.settings.of_map(self.given.views[at].camera)
        return whole.resized(max(1, round(whole.width / 2**level)), max(1, round(whole.height / 2**level)))

    def levels(self, at: int) -> int:
        """How often a photograph is halved before the planes begin in it: to about twice the size of the sweep."""
        camera = self.camera(at, 0)
        return max(0, round(math.log2(max(camera.width, camera.height) / (2 * self.settings.coarsest))))

    def read(self, at: int) -> Tensor:
        """(H, W) uint8, a photograph at full size, in the light of all and stretched."""
        camera = self.camera(at, 0)
        view = self.given.views[at]
        rgb = read_photo(view.path, (camera.width, camera.height), pixels=view.pixels).to(torch.float32)
        return stretched(255 * self.light.even(rgb.mean(0) / 255, at, camera))

    def grey(self, at: int, level: int) -> GreyImage:
        """A photograph at a level."""
        return self.greys[level](at)

    def halved(self, level: int, at: int) -> GreyImage:
        """The same, made anew; files are decoded once."""
        camera = self.camera(at, level)
        small = adaptive_avg_pool2d(self.value(at).to(torch.float32)[None], (camera.height, camera.width))[0]
        return GreyImage(camera, small.round().to(torch.uint8).numpy())

    def path(self, what: str, at: int) -> Path:
        """Where a map is kept."""
        return self.given.work / what.replace(",", "").replace(" ", "-") / f"{at:06d}.planes"

    def kept(self, what: str, at: int, make: Callable[[int], PlaneMap | None], all_made: set[int]) -> PlaneMap | None:
        """A map from the folder for work, where it is put if it is not there."""
        path = self.path(what, at)
        if not path.exists():
            made = make(at)
            save_map(path, made)
            all_made.add(at)
            emit(Progress(what, len(all_made), len(self.given.views)))
        return load_map(path)

    def is_needed(self, of: DepthMapRound, at: int) -> bool:
        """Whether anything is still to be made from a map: estimates from those of the last round, and from those of
        another one the maps of the next."""
        if of is self.last:
            return any(user in self.wanted for user in self.users[at])
        then = self.rounds[self.rounds.index(of) + 1]
        return any(user not in then.made for user in self.users[at])

    def finish(self, at: int) -> None:
        """Delete the maps that nobody needs any more when the estimate of a photograph is kept."""
        self.wanted.discard(at)
        near = {at, *self.pairs[at]}
        for of in reversed(self.rounds):
            for each in near:
                if not self.is_needed(of, each):
                    self.path(of.what, each).unlink(missing_ok=True)
            near = near.union(*(self.pairs[each] for each in near))

    def match(self, at: int) -> PlaneMap | None:
        """By photometric consistency, from coarse to fine, or at full size from a surface that is known; None without
        neighbours, parallax or sparse points."""
        others, known = self.pairs[at], self.given.known
        span = depth_range(self.given.views[at], self.given.observations, self.sweep.margin)
        begun = self.sweep.sweep(
            self.given, at, self.small(at), [self.small(o) for o in others[: self.sweep.neighbours]]
        )
        if span is None or begun is None:
            return None
        planes, parallax = Planes.at(begun[0].cpu().numpy(), len(others)), 0.0
        coarsest = self.levels(at) if known is None else 0
        for level in range(coarsest, -1, -1):
            here, there = self.grey(at, level), [self.grey(o, min(level, self.levels(o))) for o in others]
            planes = planes.resized(here.camera.height, here.camera.width)
            if known is not None:
                planes.lie_in(known.see(at, here.camera), here.camera, span)
            parallax = parallax_of(here, there, planes)
            if parallax <= 0:
                return None  # all were taken from the same place
            passes = self.passes(level, at)
            for index in range(passes):
                terms = replace(
                    self.terms(span, parallax),
                    jitter_px=JITTER_PX * 2 ** (passes - 1 - index),
                    samples=FULL_WINDOW_PIXELS if level == 0 and index == passes - 1 else COARSE_WINDOW_PIXELS,
                    survey=index == 0 and level == coarsest,
                )
                self.improve(here, there, planes, terms, seed=(at * 31 + level) * 31 + index)
        return PlaneMap(planes.value, planes.each, parallax)

    def passes(self, level: int, at: int) -> int:
        """Of photometric consistency; at full size, the pass that compares depth maps stands in for the last one."""
        fewer = (level < self.levels(at)) + (level == 0 and self.settings.consistency > 0)
        return max(1, self.settings.passes - fewer)

    def reconcile(self, at: int, before: DepthMapRound) -> PlaneMap | None:
        """One more pass, which looks at the depth maps of the others too."""
        found = before.map(at)
        span = depth_range(self.given.views[at], self.given.observations, self.sweep.margin)
        if found is None or span is None:
            return None
        known = [before.depth(near) for near in self.pairs[at]]
        planes = Planes.at(found.value[..., 0], len(known))
        planes.value[:], planes.each[:] = found.value, found.each
        terms = replace(self.terms(span, found.parallax), consistency=self.settings.consistency)
        there = [self.grey(near, 0) for near in self.pairs[at]]
        self.improve(self.grey(at, 0), there, planes, terms, seed=at * 31 + 30 - self.rounds.index(before), known=known)
        return PlaneMap(planes.value, planes.each, found.parallax)

    def terms(self, span: tuple[float, float], parallax: float) -> MatchingSettings:
        """Of the pass that compares depth maps, but for the weight of that."""
        settings = self.settings
        return MatchingSettings(
            low=span[0],
            high=span[1],
            parallax=parallax,
            jitter_px=LAST_JITTER_PX,
            smoothness=settings.smoothness,
            consistency=0.0,
            spread=255 * settings.spread,
            brightness=settings.brightness,
            samples=FULL_WINDOW_PIXELS,
            best=settings.best,
            window=settings.window,
            survey=False,
        )
