"""Splats that are too large to say where a surface is: the mesh is as if they were not there."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.mesh.oversized import without_oversized
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Splats
from surfkit.testing.inputs import mesh_input

PIXEL = 1.5 / (1.2 * 96)
"""Of the nearest view of the ball, about: cameras at 2, the ball of radius 0.5, 96 x 96 pixels."""


def with_disc():
    """The ball, and a disc of a standard deviation of 0.3 outside of it; its place is between ball and cameras."""
    subject = mesh_input(count=600, views=10)
    ball = subject.splats
    one = {name: value[:1].clone() for name, value in ball.tensors().items()}
    one |= {"means": torch.tensor([[0.0, 0.0, 1.0]]), "scales": torch.full((1, 2), 0.3)}
    both = Splats(ball.kind, *(torch.cat([value, one[name]]) for name, value in ball.tensors().items()))
    return subject, replace(subject, splats=both, draw=subject.draw_of(both))


def test_an_oversized_splat_is_as_if_it_were_not_there():
    ball, both = with_disc()
    expected, seen = TSDF().mesh(ball), TSDF().mesh(both)
    assert seen.vertices[:, 2].max() > 0.9 > expected.vertices[:, 2].max(), "the disc is a surface"
    found = TSDF(largest_px=10).mesh(both)
    assert np.array_equal(found.vertices, expected.vertices) and np.array_equal(found.faces, expected.faces)
    assert found.facts["oversized_splats"] == 1 and "oversized_splats" not in expected.facts
    assert len(without_oversized(both, 0.36 / PIXEL, "median").splats) == 601, "the limit is one of pixels"
    assert len(without_oversized(both, 0.2 / PIXEL, "median").splats) == 600


def test_what_cannot_be_left_out_is_one_line():
    ball, both = with_disc()
    with pytest.raises(BadInput, match="largest_px 0.1: all 601 .*or 0"):
        TSDF(largest_px=0.1).mesh(both)
    with pytest.raises(BadInput, match="not made of splats; give 0"):
        TSDF(largest_px=10).mesh(replace(ball, draw_of=None))
    with pytest.raises(BadInput, match="mesh.largest_px is -1"):
        TSDF(largest_px=-1)
