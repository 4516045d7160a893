"""What is to be known of the positions that place a reconstruction: wrong ones, and clocks that disagree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from surfkit.apps.sfm.camera_motion import motion_of
from surfkit.apps.sfm.georeference import ASSUMED_M, Placement
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.core.check import few

MIN_TIMED = 8
"""Photographs of known position and velocity from which a delay is estimated."""
DELAY_SIGMAS = 5.0
"""A delay is told that differs from 0 by so many of its standard deviations."""
MIN_EXPLAINED = 0.5
"""Of the sum of squares of the residuals in plan, the share that a delay must explain."""
MIN_DELAY_M = 0.3
"""Change along the flight, between photographs of different velocity, below which a delay is not worth a word."""
ROUNDS = 20
"""Of the robust fit."""
ROBUST = 2.0
"""Residuals of so many standard deviations count half (Cauchy)."""
MAD_OF_RAYLEIGH = 1.1774
"""Median length of residuals in plan whose two coordinates have a standard deviation of 1."""


@dataclass(frozen=True)
class PositionDelay:
    """By how much the positions are older than the photographs, as they say of themselves.

    Attributes:
        seconds: Positive where a position is that of a moment before the photograph.
        sigma: Its standard deviation.
        explained: Share of the sum of squares of the residuals in plan that it explains.
        reach: How far it moves positions against each other along the flight, metres: from the 10th to the 90th
            percentile.
    """

    seconds: float
    sigma: float
    explained: float
    reach: float

    @property
    def is_sure(self) -> bool:
        """Whether it is no accident, and worth a word."""
        is_real = abs(self.seconds) >= DELAY_SIGMAS * self.sigma and self.explained >= MIN_EXPLAINED
        return is_real and self.reach >= MIN_DELAY_M


def delay_of(residuals: np.ndarray, velocities: np.ndarray) -> PositionDelay | None:
    """The delay of positions against photographs that explains most of their residuals; None where velocities are too
    few or alike: all positions that are off by the same are no contradiction.

    A position that is t seconds old lies t times the velocity behind the camera. A shift that all share is free, as the
    fit to wrong positions has put it anywhere.

    Args:
        residuals: (P, 2) position less camera, east and north, metres.
        velocities: (P, 2) of the cameras, metres per second.
    """
    if len(residuals) < MIN_TIMED:
        return None
    weights, shift, delay, sigma = np.ones(len(residuals)), residuals.mean(0), 0.0, np.inf
    for _ in range(ROUNDS):
        share = weights / weights.sum()
        moved, left = velocities - share @ velocities, residuals - share @ residuals
        known = float(weights @ (moved**2).sum(1))
        if known <= 1e-12:
            return None
        delay = -float(weights @ (moved * left).sum(1)) / known
        shift = share @ (residuals + delay * velocities)
        away = np.linalg.norm(residuals + delay * velocities - shift, axis=1)
        spread = max(float(np.median(away)) / MAD_OF_RAYLEIGH, 1e-6)
        weights = 1 / (1 + (away / (ROBUST * spread)) ** 2)
        sigma = spread / np.sqrt(known)
    alone = residuals - residuals.mean(0)
    explained = 1 - float((away**2).sum()) / max(float((alone**2).sum()), 1e-12)
    main = np.linalg.svd(velocities - velocities.mean(0), full_matrices=False)[2][0]
    low, high = np.percentile(velocities @ main, [10, 90])
    return PositionDelay(delay, sigma, explained, abs(delay) * float(high - low))


def position_doubts(where: Placement, centres: Mapping[str, np.ndarray], photos: Mapping[str, Photo]) -> list[str]:
    """What a user is to know of the positions: which are left out, how many count though they contradict others, and
    whether they are older or newer than the photographs.

    Args:
        where: A reconstruction on the map.
        centres: (3,) of its cameras by name, coordinates of the map less its offset.
        photos: By name.
    """
    said = []
    if where.drifting:
        near = f"{where.drifting} of {len(where.names)} positions contradict the others by up to {ASSUMED_M:g} m"
        said.append(f"{near}; they state no accuracy, are taken for GPS without corrections, and count")
    wrong = [name for name, good in zip(where.names, where.fit.inside, strict=True) if not good]
    far = np.linalg.norm(where.fit.residuals, axis=1)[~where.fit.inside] * where.chart.metres
    if len(wrong) == 1:
        by = f"{_metres(far[0])} m"
        said.append(f"the position of {wrong[0]!r} is {by} from where the others put it, and is left out")
    elif wrong:
        by = " to ".join(dict.fromkeys(_metres(value) for value in (far.min(), far.max()))) + " m"
        said.append(f"{len(wrong)} positions are {by} from where the others put them, and are left out: {few(wrong)}")
    velocities = motion_of(centres, photos).velocities
    timed = [at for at, name in enumerate(where.names) if name in velocities]
    if timed:
        metres = where.chart.metres
        vectors = np.stack([velocities[where.names[at]].vector[:2] for at in timed]) * metres
        delay = delay_of(where.fit.residuals[timed, :2] * metres, vectors)
        if delay is not None and delay.is_sure:
            said.append(_told(delay))
    return said


def _told(delay: PositionDelay) -> str:
    """A delay, what it does, and what to do, in one line."""
    when = "before" if delay.seconds > 0 else "after"
    return (
        f"positions seem to be those of {abs(delay.seconds):.2f} s {when} each photograph: where the speed or the "
        f"heading differs, they contradict each other by {delay.reach:.1f} m along the flight. The scene may be as far "
        "off; give corrected positions with --positions, or control points with --gcp"
    )


def _metres(value: float) -> str:
    """A distance to 0.1 m, and of 10 m and more to 1 m."""
    return f"{value:.1f}" if value < 10 else f"{value:,.0f}"
