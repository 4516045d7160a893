"""Quaternions and matrices of rotations, against scipy."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from surfkit.scene.rotations import numpy_quaternions, numpy_rotations, quaternions, rotations, unit

QUATS = torch.randn(200, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
QUATS = torch.cat([QUATS, torch.eye(4).double()])  # three of them turn by 180 degrees
KNOWN = Rotation.from_quat(QUATS.numpy()[:, [1, 2, 3, 0]])


def test_matrices_are_those_of_scipy_whatever_the_length():
    for length in (1.0, 3e-9, 7e9):
        assert np.abs(rotations(length * QUATS).numpy() - KNOWN.as_matrix()).max() < 1e-14
        assert np.abs(numpy_rotations(length * QUATS.numpy()) - KNOWN.as_matrix()).max() < 1e-14
    assert rotations(1e30 * QUATS.float()).isfinite().all(), "squares beyond the range of float32"


def test_a_quarter_turn_about_z_takes_x_to_y():
    quat = np.array([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])
    for turn in (numpy_rotations(quat)[0], rotations(torch.from_numpy(quat))[0].numpy()):
        assert turn @ [1, 0, 0] == pytest.approx([0, 1, 0])


def test_quaternions_come_back_also_of_half_a_turn():
    wanted, turns = normalize(QUATS, dim=1), KNOWN.as_matrix()
    for found in (normalize(quaternions(torch.from_numpy(turns)), dim=1).numpy(), numpy_quaternions(turns)):
        assert np.abs((found * wanted.numpy()).sum(1)) == pytest.approx(1, abs=1e-12)


def test_gradients_are_those_of_finite_differences():
    some = QUATS[:5].clone().requires_grad_()
    assert torch.autograd.gradcheck(rotations, some)
    assert torch.autograd.gradcheck(lambda quats: quaternions(rotations(quats)), some)


def test_a_quaternion_of_zeros_turns_nothing():
    zeros = np.zeros((1, 4), np.float32)
    assert unit(zeros).tolist() == [[1, 0, 0, 0]] and np.array_equal(numpy_rotations(zeros)[0], np.eye(3))
