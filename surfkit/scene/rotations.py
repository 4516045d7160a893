"""Rotations as quaternions and as matrices.

Quaternions are Hamilton's, scalar first (w, x, y, z). Matrices turn column vectors: for the unit quaternion q, the
matrix times v is q v q*, counter-clockwise about (x, y, z) when that axis points at the viewer (right-handed), and its
columns are the turned axes. q and -q are the same rotation.

`rotations` and `quaternions` are for torch and have gradients; `numpy_rotations` and `numpy_quaternions` are float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor


def rotations(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotations of (N, 4) quaternions wxyz of any length but 0."""
    quats = quats / quats.detach().abs().amax(1, keepdim=True)  # lest the squares leave the range
    parts = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    return torch.stack([torch.stack(row, 1) for row in _rows(*parts)], 1)


def quaternions(turns: Tensor) -> Tensor:
    """(N, 4) quaternions wxyz of (N, 3, 3) rotations, of any length; differentiable everywhere.

    4 q_i q_j is linear in the entries of the rotation; of these four multiples of q, the longest is taken.
    """
    xx, yy, zz = turns.diagonal(dim1=1, dim2=2).unbind(1)
    (yx, zx), (xy, zy), (xz, yz) = turns[:, [1, 2], 0].T, turns[:, [0, 2], 1].T, turns[:, [0, 1], 2].T
    table = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, yx + xy, xz + zx],
        [xz - zx, yx + xy, 1 - xx + yy - zz, zy + yz],
        [yx - xy, xz + zx, zy + yz, 1 - xx - yy + zz],
    ]
    multiples = torch.stack([torch.stack(row, 1) for row in table], 1)
    longest = multiples.diagonal(dim1=1, dim2=2).argmax(1)
    return multiples.gather(1, longest[:, None, None].expand(-1, 1, 4))[:, 0]


def unit(quats: np.ndarray) -> np.ndarray:
    """(N, 4) float64 quaternions of length 1 of (N, 4) wxyz of any length; one of length 0 turns nothing."""
    wide = quats.astype(np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.where(length > 0, wide, [1.0, 0, 0, 0]) / np.where(length > 0, length, 1)


def numpy_rotations(quats: np.ndarray) -> np.ndarray:
    """(N, 3, 3) float64 rotations of (N, 4) quaternions wxyz of any length; one of length 0 turns nothing."""
    return np.stack([np.stack(row, 1) for row in _rows(*unit(quats).T)], 1)


def numpy_quaternions(turns: np.ndarray) -> np.ndarray:
    """(N, 4) float64 unit quaternions wxyz of (N, 3, 3) rotations."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(turns).as_quat()[:, [3, 0, 1, 2]]


def _rows(w: Any, x: Any, y: Any, z: Any) -> list[list[Any]]:
    """Rows of the matrix of a unit quaternion, of arrays or tensors of its components."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
