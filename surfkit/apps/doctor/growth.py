"""How many points a run will have, as far as that can be known before it."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from surfkit.densify.adc import ADC
from surfkit.densify.base import Densify
from surfkit.train.stage import Stage

MAX_FACTOR, HALF_AFTER = 36.0, 22.0
"""Many edits multiply the number of sparse points by up to the first; the second is the number of edits after which
half of that is reached. A rule of thumb: runs of 2DGS on two aerial scenes multiplied theirs by 1.6, 5 to 8, and 15 to
25 with 1, 5 and 17 edits, and published runs of 3DGS theirs by 6 to 110, mostly 20 to 60, with 145."""
DENSE_FACTOR = 5.0
"""The same for points that begin dense. Runs of recipe:surface on two aerial scenes multiplied theirs by 1.1, 1.2 and
1.5 with 2, 6 and 11 edits, and by 1.4, 1.8 and 3.3 with 2, 4 and 14."""
MAX_POINTS_PER_PIXEL = 0.3
"""Never more points than this share of the pixels of all training photographs, at the usual threshold of gradients; at
ten times that, a tenth. Runs of 2DGS on 87 photographs of 160 px came to 0.33 in 2,000 steps, and to 0.03 and 0.04 in
15,000 and 30,000 steps at ten times the threshold."""
USUAL_THRESHOLD = 2e-4
"""Threshold of gradients, with signs, that 3DGS and 2DGS publish; the sizes of gradients are larger."""
FORECAST_SPREAD_FACTOR = 3.0
"""The true number may be smaller or larger by this factor."""
USUAL_EVERY = 100
"""Steps between edits of a densifier that does not tell when it edits."""


@dataclass(frozen=True)
class Growth:
    """The number of points over a run.

    Attributes:
        first: Points at the beginning.
        last: Points at the end.
        edits: When points are added, as shares of the run, in order.
        known: Whether the recipe or the user sets `last`; else it is only likely.
        most: By how much edits multiply the points at most.
    """

    first: int
    last: int
    edits: Sequence[float]
    known: bool
    most: float = MAX_FACTOR

    def at(self, share: float) -> int:
        """Points after a share of the run."""
        if not self.edits:
            return self.first
        done = bisect_right(self.edits, share)
        risen = (factor(done, self.most) - 1) / (factor(len(self.edits), self.most) - 1)
        return round(self.first + risen * (self.last - self.first))


def factor(edits: int, most: float = MAX_FACTOR) -> float:
    """By how much edits multiply the points; never by more than `most`."""
    return 1 + (most - 1) * edits / (edits + HALF_AFTER)


def growth(stage: Stage, first: int, pixels: int, given: int | None = None, is_dense: bool = False) -> Growth:
    """How the number of points will rise.

    Args:
        stage: What the run does.
        first: Points that it starts with.
        pixels: Of all training photographs, at the size they are used at.
        given: Points at the end, where the user says so.
        is_dense: Whether the first points lie on most of the surface already.
    """
    if stage.densify is None:
        return Growth(first, first, (), True)
    edits = edit_shares(stage.densify, stage.steps)
    most, share = DENSE_FACTOR if is_dense else MAX_FACTOR, MAX_POINTS_PER_PIXEL
    if isinstance(stage.densify, ADC) and not (is_dense or stage.signal.absolute):
        share *= USUAL_THRESHOLD / max(stage.densify.threshold, USUAL_THRESHOLD)
    likely = max(first, min(round(first * factor(len(edits), most)), round(share * pixels)))
    limit = stage.densify.most_points
    last = given if given is not None else min(likely, max(limit or likely, first))
    known = given is not None or not edits or (limit is not None and last >= limit)
    return Growth(first, last if edits else first, edits, known, most)


def edit_shares(densify: Densify, steps: int) -> tuple[float, ...]:
    """When points are added in a stage of so many steps, as shares of it; evenly where the densifier does not tell."""
    edits = densify.edits(steps)
    return tuple(index / steps for index in (range(USUAL_EVERY, steps + 1, USUAL_EVERY) if edits is None else edits))
