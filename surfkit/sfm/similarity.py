"""Similarities between two sets of positions, some of them wrong.

Least trimmed squares finds the consensus (FAST-LTS; Rousseeuw and Van Driessen, 2006): fits to a few positions are
concentrated on the half that fits best. What lies within a few standard deviations of it decides, by Umeyama's weighted
least squares (1991).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surfkit.readers.georeference import Similarity

DRAWS, ROUNDS = 300, 10
"""Fits to three positions; concentrations of each."""
MOST = 1500
"""Positions among which the consensus is sought: of more, a random part stands for all, as in FAST-LTS."""
SIGMAS = 4.0
"""A position is wrong beyond so many standard deviations of the residuals: of Gaussian ones, 1 of 900 is."""
MEDIAN_OF_CHI3 = 1.5382
"""Median length of residuals whose three coordinates have a standard deviation of 1."""
PARAMETERS = 7 / 3
"""Of a similarity, in coordinates of a position."""
FEWEST = 4
"""Positions that must agree; any three fit a similarity nearly."""


@dataclass(frozen=True)
class Fit:
    """A similarity from one set of positions to another.

    Attributes:
        similarity: onto = similarity(xyz).
        inside: (P,) bool, which positions agree with it.
        residuals: (P, 3) onto - similarity(xyz).
        sigma: (3,) standard deviations of the residuals that agree, by coordinate.
    """

    similarity: Similarity
    inside: np.ndarray
    residuals: np.ndarray
    sigma: np.ndarray


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
    xyz: np.ndarray, onto: np.ndarray, sigma: np.ndarray | None = None, seed: int = 0, least: float = 0.0
) -> Fit | None:
    """The similarity on which most positions agree; None where fewer than `FEWEST` do.

    Args:
        xyz: (P, 3) float64.
        onto: (P, 3) float64.
        sigma: (P,) standard deviations of `onto`, in its unit, where they are known; equal ones otherwise.
        seed: Of the draws.
        least: A position with a shorter residual is never wrong, in the unit of `onto`.
    """
    count = len(xyz)
    if count < FEWEST:
        return None
    spread = np.ones(count) if sigma is None else np.asarray(sigma, np.float64)
    weights = 1 / spread**2
    best = _consensus(xyz, onto, weights, np.random.default_rng(seed))
    inside = np.ones(count, bool)
    small = 1 + 5 / (count - PARAMETERS)  # of few positions a fit comes too near to some (Rousseeuw and Leroy, 1987)
    for _ in range(ROUNDS):
        away = np.linalg.norm(onto - best.points(xyz), axis=1)
        length = away / spread
        unit = max(small * float(np.median(length)) / MEDIAN_OF_CHI3, 1e-9)
        now = (length <= SIGMAS * unit) | (away <= least)
        if now.sum() < FEWEST:
            return None
        best = umeyama(xyz, onto, weights * now)
        if (now == inside).all():
            break
        inside = now
    residuals = onto - best.points(xyz)
    found = np.sqrt((residuals[inside] ** 2).mean(0) * inside.sum() / max(inside.sum() - PARAMETERS, 1))
    return Fit(best, inside, residuals, found)


def _consensus(xyz: np.ndarray, onto: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> Similarity:
    """The fit with the least sum of squares over its best half."""
    if len(xyz) > MOST:
        part = rng.choice(len(xyz), MOST, replace=False)
        xyz, onto, weights = xyz[part], onto[part], weights[part]
    count = len(xyz)
    half = max(FEWEST, (count + 4) // 2)
    best, least = umeyama(xyz, onto, weights), np.inf
    for _ in range(DRAWS if count > FEWEST else 1):
        chosen = np.zeros(count, bool)
        chosen[rng.choice(count, 3, replace=False)] = True
        for _ in range(ROUNDS):
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
