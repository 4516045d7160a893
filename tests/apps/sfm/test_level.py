"""Up, from cameras that are held level."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfkit.apps.sfm.gravity_alignment import turn_upright, up_direction

from .pictures import looking

TURNED = Rotation.from_rotvec([0.8, -0.5, 0.3]).as_matrix()
"""Of the world: up is its third column."""


def turned(poses):
    poses = np.stack(poses)
    poses[:, :3, :3] = poses[:, :3, :3] @ TURNED.T
    return poses


def ground(seed=0):
    return np.random.default_rng(seed).normal(0, 1, (500, 3)) * (20, 20, 1) @ TURNED.T


@pytest.mark.parametrize("roll, orientation", [(0, 1), (np.pi, 3), (np.pi / 2, 8), (-np.pi / 2, 6)])
def test_up_of_cameras_that_look_around(roll, orientation):
    poses = turned([looking((9 * np.cos(a), 9 * np.sin(a), 6), roll=roll) for a in np.linspace(0, 5, 9)])
    up = up_direction(poses, [orientation] * 9, np.zeros((0, 3)))
    np.testing.assert_allclose(up, TURNED[:, 2], atol=1e-6)


def test_up_of_a_strip_without_a_turn_needs_the_ground():
    """A survey drone looks straight down and never turns."""
    poses = turned([looking((at, 1e-6 - 1e-9, 50), (at, 1e-6, 0)) for at in range(8)])
    up = up_direction(poses, [1] * 8, ground())
    assert up @ TURNED[:, 2] > 0.995


def test_the_turn_brings_up_to_z():
    for up in (*np.random.default_rng(0).normal(0, 1, (5, 3)), [0, 0, 1.0], [0, 0, -1.0]):
        up = np.asarray(up) / np.linalg.norm(up)
        turn = turn_upright(up)
        np.testing.assert_allclose(turn @ up, [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)
