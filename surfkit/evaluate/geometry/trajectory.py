"""Alignment by the cameras, as Tanks and Temples does it: the poses of a reconstruction are brought onto those of the
benchmark, which come with a transform into the frame of the laser scan (Knapitsch et al., Tanks and Temples, 2017)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.transform import apply, fitted

SAMPLE, ROUNDS = 6, 1000
"""Cameras that a trial is fitted to, and trials."""
INLIER_MEDIANS = 3.0
"""A camera counts in the last fit if it misses by at most so many medians of the best trial."""
ENTRY_LINES = 5
"""Of a camera in a log: its numbers, then the matrix."""


def read_log(path: Path) -> np.ndarray:
    """(n, 3) camera centres of a trajectory file (`Barn_COLMAP_SfM.log`): for each photograph in the order of their
    names a line of three numbers, and four lines with the matrix from the camera to the world.

    Raises:
        BadInput: Not such a file.
    """
    try:
        lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
        matrices = [lines[at + 1 : at + ENTRY_LINES] for at in range(0, len(lines), ENTRY_LINES)]
        found = np.array(matrices, np.float64)
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise BadInput(
            f"{path}: no trajectory: each camera must have a line of numbers and four of a matrix"
        ) from error
    if found.ndim != 3 or found.shape[1:] != (4, 4) or not np.isfinite(found).all():
        raise BadInput(f"{path}: no trajectory: each camera must have a line of numbers and a matrix of 4 x 4")
    return found[:, :3, 3]


def onto_trajectory(centres: np.ndarray, trajectory: np.ndarray, seed: int = 0) -> np.ndarray:
    """(4, 4) similarity that brings camera centres onto those of the benchmark, some of which may be wrong.

    Of many fits to six cameras, the one with the least median distance says which cameras count in the last fit.

    Args:
        centres: (n, 3) of the reconstruction.
        trajectory: (n, 3) of the same photographs.
        seed: Of the choice.

    Raises:
        BadInput: Not equally many, or fewer than six.
    """
    if len(centres) != len(trajectory) or len(centres) < SAMPLE:
        raise BadInput(
            f"{len(centres)} cameras for {len(trajectory)} of the trajectory; there must be as many, and "
            f"at least {SAMPLE}"
        )
    draw, best, least = np.random.default_rng(seed), np.eye(4), np.inf
    for _ in range(ROUNDS):
        chosen = draw.choice(len(centres), SAMPLE, replace=False)
        matrix = fitted(centres[chosen], trajectory[chosen], with_scale=True)
        median = float(np.median(np.linalg.norm(apply(matrix, centres) - trajectory, axis=1)))
        if median < least:
            best, least = matrix, median
    missed = np.linalg.norm(apply(best, centres) - trajectory, axis=1)
    inliers = missed <= max(INLIER_MEDIANS * least, float(np.partition(missed, SAMPLE - 1)[SAMPLE - 1]))
    return fitted(centres[inliers], trajectory[inliers], with_scale=True)
