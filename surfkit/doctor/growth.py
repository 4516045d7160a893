"""How many points a run will have, as far as that can be known before it."""

from __future__ import annotations

from dataclasses import dataclass

from surfkit.densify.base import Densify
from surfkit.densify.filters import CountCap
from surfkit.train.stage import Stage

MOST_TIMES, HALF_AFTER = 36.0, 22.0
"""With many edits, a run multiplies its sparse points by so much; with so many edits, by half of that. A rule of thumb:
runs of 2DGS on two aerial scenes multiplied theirs by 1.6, 5 to 8, and 15 to 25 with 1, 5 and 17 edits, and published
runs of 3DGS theirs by 6 to 110, mostly 20 to 60, with 145."""
PER_PIXEL = 0.3
"""Never more points than this share of the pixels of all training photographs."""
SPREAD = 3.0
"""The true number may be smaller or larger by this factor."""


@dataclass(frozen=True)
class Growth:
    """The number of points over a run.

    Attributes:
        first: Points at the beginning.
        last: Points at the end.
        start: Share of the run before the first edit.
        until: Share of the run before the last edit.
        edits: From the first to the last.
        known: Whether the recipe or the user sets `last`; else it is only likely.
    """

    first: int
    last: int
    start: float
    until: float
    edits: int
    known: bool

    def at(self, share: float) -> int:
        """Points after a share of the run."""
        way = (share - self.start) / max(self.until - self.start, 1e-9)
        done = round(self.edits * min(max(way, 0.0), 1.0))
        risen = (times(done) - 1) / (times(self.edits) - 1) if self.edits else 0.0
        return round(self.first + risen * (self.last - self.first))


def times(edits: int) -> float:
    """By how much edits multiply the points of a sparse cloud."""
    return 1 + (MOST_TIMES - 1) * edits / (edits + HALF_AFTER)


def growth(stage: Stage, sparse: int, pixels: int, given: int | None = None) -> Growth:
    """How the number of points will rise.

    Args:
        stage: What the run does.
        sparse: Points that it starts with.
        pixels: Of all training photographs, at the size they are used at.
        given: Points at the end, where the user says so.
    """
    if stage.densify is None:
        return Growth(sparse, sparse, 0.0, 1.0, 0, True)
    start, until, every = (getattr(stage.densify, name, None) for name in ("start", "until", "every"))
    start, until = start or 0, min(until or stage.steps, stage.steps)
    edits = max(0, (until - 1) // (every or 100) - start // (every or 100))
    likely = max(sparse, min(round(sparse * times(edits)), round(PER_PIXEL * pixels)))
    cap = most_points(stage.densify)
    last = given if given is not None else min(likely, max(cap or likely, sparse))
    known = given is not None or edits == 0 or (cap is not None and last >= cap)
    return Growth(sparse, last if edits else sparse, start / stage.steps, until / stage.steps, edits, known)


def most_points(densify: Densify) -> int | None:
    """The number of points beyond which a way to densify does not go, if it has one."""
    caps = [one.points for one in getattr(densify, "filters", ()) if isinstance(one, CountCap)]
    own = getattr(densify, "cap", None)
    return min([*caps, *([own] if isinstance(own, int) else [])], default=None)
