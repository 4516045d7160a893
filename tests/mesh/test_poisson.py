"""Poisson reconstruction of the ball of `test_tetra`."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from needs import needs

from surfkit.core.check import BadInput
from surfkit.mesh.poisson import Poisson
from surfkit.testing.inputs import BALL_RADIUS, mesh_input

from .test_tetra import volume

needs("open3d", "mesh:poisson")


def test_a_ball():
    mesh = Poisson(octree=6, points=30_000, thin=0.0).mesh(mesh_input())
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - BALL_RADIUS).mean() < 0.01 and np.abs(radius - BALL_RADIUS).max() < 0.05
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(4 / 3 * np.pi * BALL_RADIUS**3, rel=0.06), (
        "it faces outwards"
    )
    assert (np.abs(mesh.colors.astype(int) - [255, 0, 0]).max(1) < 80).mean() > 0.9


def test_what_is_thinly_seen_goes():
    """Cameras on one side: the far half, which Poisson makes up, has hardly any points around it."""
    given = mesh_input()
    near = [at for at, view in enumerate(given.views) if view.camera.centre[0] > 1.0]
    given = replace(given, views=[given.views[at] for at in near])
    whole, cut = (Poisson(octree=5, points=20_000, thin=thin).mesh(given) for thin in (0.0, 0.3))
    assert 0.7 * len(whole.vertices) < len(cut.vertices) < 0.9 * len(whole.vertices)
    assert cut.vertices[:, 0].mean() > whole.vertices[:, 0].mean() + 0.02


def test_nothing_to_see():
    given = mesh_input()
    with pytest.raises(BadInput, match="only 0 pixels"):
        Poisson().mesh(replace(given, keep=lambda at: torch.zeros(96, 96, dtype=torch.bool)))


@pytest.mark.parametrize("settings", [{"octree": 2}, {"octree": 20}, {"points": 10}, {"thin": 1.0}])
def test_bad_settings(settings):
    with pytest.raises(BadInput, match="poisson"):
        Poisson(**settings)
