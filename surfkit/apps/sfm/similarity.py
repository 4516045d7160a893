"""Similarities between two sets of positions, some of them wrong.

Least trimmed squares finds the consensus (FAST-LTS; Rousseeuw and Van Driessen, 2006): fits to a few positions are
concentrated on the half that fits best. What lies within a few standard deviations of it decides, by Umeyama's weighted
least squares (1991). Positions of different accuracy are weighed by how far each group of them is off in fact, which is
estimated in turn with the fit (variance components; Koch, 1999), and never by less than they state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from surfkit.io.datasets.topocentric import Similarity

TRIPLE_DRAWS, CONCENTRATION_STEPS = 300, 10
"""Fits to three positions; concentrations of each."""
MAX_FIT_ROUNDS = 60
"""Of the last fit: the weights of a few accurate positions rise to their own by about a half a round."""
SIGMA_GROUP_FACTOR = 3.0
"""Where standard deviations, in their order, rise by this factor from one to the next, another group begins."""
MAX_CONSENSUS_POSITIONS = 1500
"""Positions among which the consensus is sought: of more, a random part stands for all, as in FAST-LTS."""
OUTLIER_SIGMAS = 4.0
"""A position is wrong beyond so many standard deviations of the residuals: of Gaussian ones, 1 of 900 is."""
MEDIAN_OF_CHI3 = 1.5382
"""Median length of residuals whose three coordinates have a standard deviation of 1."""
PARAMETERS = 7 / 3
"""Of a similarity, in coordinates of a position."""
MAX_SETTLED_MOVE = 1e-6
"""A fit that moves by less, in standard deviations of the most accurate position, moves no more."""
MIN_AGREEING_POSITIONS = 4
"""Positions that must agree; any three fit a similarity nearly."""


@dataclass(frozen=True)
class SimilarityFit:
    """A similarity from one set of positions to another.

    Attributes:
        similarity: onto = similarity(xyz).
        inside: (P,) bool, which positions agree with it.
        residuals: (P, 3) onto - similarity(xyz).
        sigma: (3,) standard deviations of the residuals that agree, by coordinate.
        spread: (P,) standard deviation of a coordinate of each position, by what it states and by its residuals.
    """

    similarity: Similarity
    inside: np.ndarray
    residuals: np.ndarray
    sigma: np.ndarray
    spread: np.ndarray

    def deviation(self, rows: np.ndarray) -> np.ndarray:
        """(3,) standard deviations of the residuals of some positions, (P,) bool, that agree, by coordinate."""
        rows = rows & self.inside
        if not rows.any():
            return np.zeros(3)
        free = self.inside.sum() / max(self.inside.sum() - PARAMETERS, 1)
        return np.sqrt((self.residuals[rows] ** 2).mean(0) * free)

    def turn_error(self, xyz: np.ndarray) -> float:
        """Standard error of the turn about the line along which the positions (P, 3) say most, radians."""
        root = (self.inside / self.spread)[:, None]
        middle = (root**2 * xyz).sum(0) / (root**2).sum()
        known = self.similarity.scale * np.linalg.svd(root * (xyz - middle), compute_uv=False)[1]
        return 1 / max(known, 1e-300)


def umeyama(xyz: np.ndarray, onto: np.ndarray, weights: np.ndarray) -> Similarity:
    """The similarity of least weighted squares.

    Args:
        xyz: (P, 3) float64.
        onto: (P, 3) float64.
        weights: (P,) at least 0, of which three or more are above.
    """
    share = weights / weights.sum()
    centre, there = share @ xyz, share @ onto
    away, target = xyz - centre, onto - there
    left, sizes, right = np.linalg.svd((target * share[:, None]).T @ away)
    mirror = np.ones(3)
    mirror[2] = np.sign(np.linalg.det(left) * np.linalg.det(right)) or 1.0
    turn = left * mirror @ right
    scale = float((sizes * mirror).sum() / max(share @ (away**2).sum(1), 1e-300))
    return Similarity(turn, scale, there - scale * turn @ centre)


def fit_robustly(
    xyz: np.ndarray,
    onto: np.ndarray,
    sigma: np.ndarray | None = None,
    seed: int = 0,
    least: float | np.ndarray = 0.0,
) -> SimilarityFit | None:
    """The similarity on which most positions agree; None where fewer than `MIN_AGREEING_POSITIONS` do.

    Args:
        xyz: (P, 3) float64.
        onto: (P, 3) float64.
        sigma: (P,) standard deviations of `onto`, in its unit, where they are known; equal ones otherwise.
        seed: Of the draws.
        least: A position with a shorter residual is never wrong, in the unit of `onto`; one for all, or (P,).
    """
    count = len(xyz)
    if count < MIN_AGREEING_POSITIONS:
        return None
    stated = np.ones(count) if sigma is None else np.asarray(sigma, np.float64)
    groups = _groups(stated)
    best = _consensus(xyz, onto, 1 / stated**2, np.random.default_rng(seed))
    inside = np.ones(count, bool)
    for _ in range(MAX_FIT_ROUNDS):
        away = np.linalg.norm(onto - best.points(xyz), axis=1)
        spread, limit = _spread(away, stated, groups)
        now = (away <= OUTLIER_SIGMAS * limit) | (away <= least)
        if now.sum() < MIN_AGREEING_POSITIONS:
            return None
        before, best = best, umeyama(xyz, onto, now / spread**2)
        moved = np.abs(best.points(xyz) - before.points(xyz)).max()
        if (now == inside).all() and moved <= MAX_SETTLED_MOVE * spread.min():
            break
        inside = now
    residuals = onto - best.points(xyz)
    if len(groups) == 1:
        free = inside.sum() / max(inside.sum() - PARAMETERS, 1)
        spread = stated * max(np.sqrt(((residuals[inside] / stated[inside, None]) ** 2).mean() * free), 1e-9)
    fit = SimilarityFit(best, inside, residuals, np.zeros(3), spread)
    return replace(fit, sigma=fit.deviation(inside))


def _groups(stated: np.ndarray) -> list[np.ndarray]:
    """Rows of positions that state about the same accuracy, the most accurate first."""
    order = np.argsort(stated, kind="stable")
    steps = np.flatnonzero(stated[order][1:] > SIGMA_GROUP_FACTOR * stated[order][:-1]) + 1
    return np.split(order, steps)


def _spread(away: np.ndarray, stated: np.ndarray, groups: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(P,) standard deviations that go with residuals of these lengths, and (P,) those by which a position is wrong.

    That of the largest group is as its residuals are, whatever it states. That of another is at least what it states,
    as a few accurate positions determine a fit, which then comes too near to them, and at most that of the largest
    group or what it states, as otherwise a group that is wrong as a whole would count as a poor one.
    """
    spread, limit = np.empty(len(away)), np.empty(len(away))
    largest = max(groups, key=len)
    for rows in (largest, *(rows for rows in groups if rows is not largest)):
        unit = max(float(np.median(away[rows] / stated[rows])) / MEDIAN_OF_CHI3, 1e-9)
        # of few positions a fit comes too near to some (Rousseeuw and Leroy, 1987)
        small = 1 + 5 / (len(rows) - PARAMETERS) if len(rows) >= MIN_AGREEING_POSITIONS else 1.0
        if rows is largest:
            spread[rows], limit[rows] = unit * stated[rows], small * unit * stated[rows]
            continue
        least, most = stated[rows], np.maximum(stated[rows], spread[largest].max())
        spread[rows] = np.clip(unit * stated[rows], least, most)
        limit[rows] = np.clip(small * unit * stated[rows], least, most)
    return spread, limit


def _consensus(xyz: np.ndarray, onto: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> Similarity:
    """The fit with the least sum of squares over its best half."""
    if len(xyz) > MAX_CONSENSUS_POSITIONS:
        part = rng.choice(len(xyz), MAX_CONSENSUS_POSITIONS, replace=False)
        xyz, onto, weights = xyz[part], onto[part], weights[part]
    count = len(xyz)
    half = max(MIN_AGREEING_POSITIONS, (count + 4) // 2)
    best, least = umeyama(xyz, onto, weights), np.inf
    for _ in range(TRIPLE_DRAWS if count > MIN_AGREEING_POSITIONS else 1):
        chosen = np.zeros(count, bool)
        chosen[rng.choice(count, 3, replace=False)] = True
        for _ in range(CONCENTRATION_STEPS):
            trial = umeyama(xyz, onto, weights * chosen)
            squares = ((onto - trial.points(xyz)) ** 2).sum(1) * weights
            rows = np.argpartition(squares, half - 1)[:half]
            now = np.zeros(count, bool)
            now[rows] = True
            if (now == chosen).all():
                break
            chosen = now
        if (total := float(squares[chosen].sum())) < least:
            best, least = trial, total
    return best
