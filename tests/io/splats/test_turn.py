"""Splats in another frame look as they did: rotations, harmonics and sizes are turned with them."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.special
import torch
from scipy.spatial.transform import Rotation

from surfkit.core.check import BadInput
from surfkit.io.splats.rotate_splats import basis, parts_of, turned
from surfkit.testing.format_checks import splat_table

TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


def directions(count=50):
    found = np.random.default_rng(1).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def real_harmonic(degree, order, towards):
    """From the complex one of scipy, which has the Condon-Shortley phase."""
    polar, around = np.arccos(towards[:, 2]), np.arctan2(towards[:, 1], towards[:, 0])
    if hasattr(scipy.special, "sph_harm_y"):
        value = scipy.special.sph_harm_y(degree, abs(order), polar, around)
    else:
        value = scipy.special.sph_harm(abs(order), degree, around, polar)
    return value.real if order == 0 else np.sqrt(2) * (value.real if order > 0 else value.imag)


def test_the_basis_is_that_of_the_specification():
    towards = directions()
    wanted = [real_harmonic(degree, order, towards) for degree in range(4) for order in range(-degree, degree + 1)]
    np.testing.assert_allclose(basis(towards, 3), np.stack(wanted, 1), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_turn_with_the_splats(degree):
    table = splat_table(count=4, degree=degree)
    table = replace(table, sh_rest=table.sh_rest.double(), sh0=table.sh0.double())
    new, towards = turned(table, TURN), directions()

    def seen(found, towards):
        coefficients = torch.cat([found.sh0[:, None], found.sh_rest], 1)
        return np.einsum("pk,nkc->npc", basis(towards, degree), coefficients)

    np.testing.assert_allclose(seen(new, towards @ TURN.T), seen(table, towards), atol=1e-12)


def test_shapes_turn_grow_and_move():
    table, move = splat_table(count=20), np.array([5e6, -3.0, 0.5])
    table = replace(table, means=table.means.double(), quats=table.quats.double(), log_scales=table.log_scales.double())
    new = turned(table, TURN, 2.5, move)
    np.testing.assert_allclose(new.means, 2.5 * table.means.numpy() @ TURN.T + move, rtol=0, atol=1e-8)

    def covariances(found):
        axes = Rotation.from_quat(np.roll(found.quats.numpy(), -1, 1)).as_matrix()
        return np.einsum("nij,nj,nkj->nik", axes, np.exp(2 * found.log_scales.numpy()), axes)

    np.testing.assert_allclose(covariances(new), 2.5**2 * TURN @ covariances(table) @ TURN.T, rtol=1e-9, atol=1e-12)


def test_what_does_not_change_keeps_its_bits():
    table = splat_table(count=9, degree=3)
    for new in (turned(table, np.eye(3)), turned(table, np.eye(3), 1.0, np.zeros(3))):
        assert all(torch.equal(getattr(new, name), getattr(table, name)) for name in ("means", "quats", "sh_rest"))
        assert new.means.dtype == torch.float32


def test_matrices_that_splats_cannot_follow_are_refused():
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 3 * TURN, [1, 2, 3]
    turn, scale, move = parts_of(matrix)
    np.testing.assert_allclose(turn, TURN)
    assert scale == pytest.approx(3) and move.tolist() == [1, 2, 3]
    for inner in (np.diag([1, 1, -1.0]), np.diag([1, 1, 2.0]), np.zeros((3, 3)), np.eye(3) + np.eye(3, k=1)):
        matrix[:3, :3] = inner
        with pytest.raises(BadInput, match="turn, move and scale"):
            parts_of(matrix)
