"""The normal equations of least squares over photographs, of which each shares places with a few others."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix, sparray, spmatrix
from scipy.sparse.linalg import SuperLU, splu


def factorised(normal: spmatrix | sparray) -> SuperLU:
    """The factors of a positive definite (N, N) matrix; `solve` of them solves for right sides.

    Unknowns are eliminated in the order of least degree (George and Liu, The Evolution of the Minimum Degree Ordering
    Algorithm, SIAM Review 1989), without pivots.
    """
    options = {"SymmetricMode": True}
    return splu(csc_matrix(normal), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def solved(normal: spmatrix | sparray, side: np.ndarray, border: int) -> np.ndarray:
    """The unknowns of normal equations, those of photographs before those of cameras, which all photographs share.

    The latter are eliminated last: otherwise they fill the factors, and the time grows with the cube of the number of
    photographs.

    Args:
        normal: (N, N) positive definite.
        side: (N,) or (N, K) right sides.
        border: How many unknowns, the last ones, are shared.

    Returns:
        As `side`.
    """
    matrix, inner = csc_matrix(normal), len(side) - border
    factors, across = factorised(matrix[:inner, :inner]), matrix[:inner, inner:].toarray()
    by_border, own = factors.solve(across), factors.solve(np.ascontiguousarray(side[:inner]))
    shared = np.linalg.solve(matrix[inner:, inner:].toarray() - across.T @ by_border, side[inner:] - across.T @ own)
    return np.concatenate([own - by_border @ shared, shared])
