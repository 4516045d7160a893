"""Splats in another frame: turned, scaled and moved, with their spherical harmonics."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.io.splats.splat_table import SplatTable
from surfkit.scene.rotations import numpy_quaternions

MAX_ORTHOGONALITY_ERROR = 1e-4
"""Most by which the columns of a matrix may differ from perpendicular and equally long."""
TEST_DIRECTIONS = 64
"""On which two sets of coefficients must give the same colours; degree 3 has 16 unknowns."""


def turned(table: SplatTable, turn: np.ndarray, scale: float = 1.0, move: np.ndarray | None = None) -> SplatTable:
    """The same splats in another frame: new = scale * turn @ old + move.

    What does not change keeps its bits; positions become float64 otherwise, except where axes only change places.

    Args:
        table: N splats.
        turn: (3, 3) rotation, or one that mirrors too: ellipsoids have no hand.
        scale: New units per old unit, above 0.
        move: (3,) new units; None for none.
    """
    turn = np.asarray(turn, np.float64)
    if not np.array_equal(turn, np.eye(3)):
        means = table.means.detach().cpu().double() @ torch.from_numpy(turn.T.copy())
        table = replace(
            table,
            means=means.to(table.means.dtype) if np.isin(turn, (-1, 0, 1)).all() else means,
            quats=_turned_quats(table.quats.detach().cpu(), turn),
            sh_rest=_turned_harmonics(table.sh_rest.detach().cpu(), turn),
        )
    if scale != 1.0:
        means = table.means.detach().cpu().double() * scale
        table = replace(table, means=means, log_scales=table.log_scales + math.log(scale))
    if move is not None and np.any(move):
        means = table.means.detach().cpu().double() + torch.from_numpy(np.asarray(move, np.float64))
        table = replace(table, means=means)
    return table


def parts_of(matrix: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation (3, 3), scale and translation (3,) of a (4, 4) matrix that is a similarity.

    Raises:
        BadInput: It mirrors, shears or scales axes differently: splats would be no splats any more.
    """
    matrix = np.asarray(matrix, np.float64)
    inner = matrix[:3, :3]
    lengths = np.linalg.norm(inner, axis=0)
    scale = float(lengths.mean())
    sound = np.isfinite(matrix).all() and scale > 0 and np.array_equal(matrix[3], [0, 0, 0, 1])
    if sound:
        apart = np.abs(inner.T @ inner / scale**2 - np.eye(3)).max()
        sound = apart < MAX_ORTHOGONALITY_ERROR and np.linalg.det(inner) > 0
    if not sound:
        raise BadInput("a node mirrors, shears or stretches; only nodes that turn, move and scale evenly are read")
    return (np.eye(3) if np.array_equal(inner, scale * np.eye(3)) else inner / scale), scale, matrix[:3, 3]


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """(P, K) real spherical harmonics of (P, 3) unit vectors, signs and order as in files of 3DGS and in glTF."""
    x, y, z = directions.T
    values = [np.full(len(directions), 0.28209479177387814)]
    if degree > 0:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 1:
        values += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
        values += [0.31539156525252005 * (2 * z * z - x * x - y * y), -1.0925484305920792 * x * z]
        values += [0.5462742152960396 * (x * x - y * y)]
    if degree > 2:
        values += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z]
        values += [-0.4570457994644658 * y * (4 * z * z - x * x - y * y)]
        values += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        values += [-0.4570457994644658 * x * (4 * z * z - x * x - y * y)]
        values += [1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)]
    return np.stack(values, axis=1)


def _turned_harmonics(rest: Tensor, turn: np.ndarray) -> Tensor:
    """(N, K - 1, 3) coefficients that give each direction the colour that it had before it was turned."""
    degree = math.isqrt(rest.shape[1] + 1) - 1
    if not degree:
        return rest
    directions = np.random.default_rng(0).normal(size=(TEST_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    new, old = basis(directions, degree), basis(directions @ turn, degree)
    mix = np.zeros((rest.shape[1], rest.shape[1]))
    for band in range(1, degree + 1):  # a rotation mixes coefficients of one degree only
        part = slice(band * band, (band + 1) * (band + 1))
        inner = slice(part.start - 1, part.stop - 1)
        mix[inner, inner] = np.linalg.lstsq(new[:, part], old[:, part], rcond=None)[0]
    mix[np.abs(mix) < 1e-12] = 0.0
    return torch.einsum("ij,njc->nic", torch.from_numpy(mix), rest.double()).to(rest.dtype)


def _turned_quats(quats: Tensor, turn: np.ndarray) -> Tensor:
    """(N, 4) wxyz of the same lengths; a mirrored ellipsoid is the one turned by the opposite matrix."""
    w, x, y, z = numpy_quaternions(turn[None] * np.sign(np.linalg.det(turn)))[0]
    product = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    return (quats.double() @ product.T).to(quats.dtype)
