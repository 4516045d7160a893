"""Where a reconstruction lies in the frame of the truth: turns, shifts, changes of size, and the files with them."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json, write_json
from surfkit.core.files import replacing

MATRIX_KEYS = ("transform", "transformation", "matrix", "trans")
"""Keys under which JSON files hold a matrix."""
MAX_SIMILARITY_ERROR = 1e-3
"""By which a matrix may miss being a turn times a size."""


def apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 3) float64 of (n, 3) points after a (4, 4) matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def seen_from(matrix: np.ndarray, box: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The box, as (3,) least and greatest coordinates, about the corners of a box in another frame."""
    corners = apply(matrix, np.array(list(product(*zip(*box, strict=True)))))
    return corners.min(0), corners.max(0)


def scale_of(matrix: np.ndarray) -> float:
    """By how much a (4, 4) similarity changes lengths."""
    return float(np.cbrt(np.linalg.det(matrix[:3, :3])))


def fitted(source: np.ndarray, target: np.ndarray, with_scale: bool) -> np.ndarray:
    """(4, 4) turn, shift and, if wanted, size that bring points closest to others in the mean square (Umeyama, 1991).

    Args:
        source: (n, 3) points, at least 3.
        target: (n, 3) where each shall come to lie.
        with_scale: Whether the size may change.
    """
    here, there = source.mean(0), target.mean(0)
    a, b = source - here, target - there
    u, stretch, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    turn = (u * sign) @ vt
    spread = (a**2).sum() / len(a)
    scale = float(stretch @ sign / spread) if with_scale and spread > 0 else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = scale * turn
    matrix[:3, 3] = there - scale * turn @ here
    return matrix


def read_transform(path: Path) -> np.ndarray:
    """(4, 4) float64 of a file: four rows of four numbers (Tanks and Temples, CloudCompare), or JSON of such rows.

    It takes the frame of the reconstruction to the frame of the truth.

    Raises:
        BadInput: Not such a file, or not a turn, a shift and one change of size.
    """
    try:
        values = _from_json(path) if path.suffix.lower() == ".json" else [float(w) for w in path.read_text().split()]
        matrix = np.array(values, np.float64).reshape(-1)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, OverflowError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"{path}: must hold four rows of four numbers, and nothing else") from error
    if matrix.size != 16:
        raise BadInput(f"{path}: {matrix.size} numbers; a transform is four rows of four")
    return _similarity(path, matrix.reshape(4, 4))


def _from_json(path: Path) -> object:
    data = read_json(path, Any)
    if not isinstance(data, dict):
        return data
    found = [name for name in MATRIX_KEYS if name in data]
    if not found:
        raise BadInput(
            f"{path}: no matrix in it under {', '.join(MATRIX_KEYS)}; its keys: {', '.join(map(str, data)) or 'none'}"
        )
    return data[found[0]]


def _similarity(path: Path, matrix: np.ndarray) -> np.ndarray:
    linear = matrix[:3, :3]
    if not np.isfinite(matrix).all() or not np.allclose(matrix[3], [0, 0, 0, 1]) or np.linalg.det(linear) <= 0:
        raise BadInput(f"{path}: no transform: it must be finite, not mirror, and end with the row 0 0 0 1")
    turn = linear / scale_of(matrix)
    if not np.allclose(turn @ turn.T, np.eye(3), atol=MAX_SIMILARITY_ERROR):
        raise BadInput(f"{path}: it shears or stretches; only turns, shifts and one change of size are allowed")
    return matrix


def write_transform(path: Path, matrix: np.ndarray) -> None:
    """Save a (4, 4) matrix: as JSON where the name ends so, else as four rows of text."""
    if path.suffix.lower() == ".json":
        write_json(path, {"transform": matrix.tolist()})
        return
    with replacing(path) as file:
        file.write("".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in matrix).encode())
