"""Depth maps with more pixels than the photographs: what they are, and that they show more."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh import oversampling
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.oversampling import magnified, oversampled
from surfkit.mesh.tsdf import TSDF

from .shapes import look_at, maps_of, slope, subject, torus

LENGTHS = {"voxel": 0.3, "truncation": 0.6, "depth_limit": 40.0, "least_views": 0.05}


def drawn(cameras, shape):
    """What a mesher is given, with exact maps at whatever size they are asked for."""

    def draw_of(splats):
        return lambda view: maps_of(view.camera, shape)

    return subject(cameras, shape, draw=draw_of(None), draw_of=draw_of)


def cameras(size):
    by = size[0] / 48
    return [replace(look_at(2 * eye, focal=45.0 * by, size=size), cx=24.5 * by, cy=17.5 * by) for eye in np.eye(3)]


def test_the_mesh_is_that_of_larger_pictures():
    found = TSDF(**LENGTHS, oversampling=2).mesh(drawn(cameras((48, 36)), torus))
    true = TSDF(**LENGTHS).mesh(drawn(cameras((96, 72)), torus))
    assert np.array_equal(found.vertices, true.vertices) and np.array_equal(found.faces, true.faces)
    assert len(found.faces) != len(TSDF(**LENGTHS).mesh(drawn(cameras((48, 36)), torus)).faces)


def test_automatic_lengths_are_those_of_the_photographs():
    given = drawn(cameras((48, 36)), torus)
    one, more = (TSDF(oversampling=by, least_views=0.05).mesh(given).facts for by in (1, 1.5))
    assert one == more


def test_a_surface_seen_from_the_side_loses_fewer_places():
    eyes = [2.0, 0.0, 0.12], [0.0, 2.0, 0.15]  # rays to the middle meet the plane at 15 and 22 degrees
    given = drawn([look_at(eye, focal=45.0, size=(48, 36)) for eye in eyes], slope)
    settings = {"voxel": 0.2, "truncation": 0.4, "depth_limit": 40.0, "least_views": 0.01}
    areas = [area(TSDF(**settings, oversampling=by).mesh(given)) for by in (1, 3)]
    assert areas[1] > 1.2 * areas[0]


def area(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(float) for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_masks_and_priors_have_the_size_of_what_is_drawn():
    given = drawn(cameras((48, 36)), torus)
    left = torch.zeros(36, 48, dtype=torch.bool)
    left[:, :20] = True
    numbers = torch.arange(36 * 48.0).reshape(36, 48)
    plane = 0.5 + 0.002 * torch.arange(48.0).expand(36, -1)
    prior = DepthPrior(plane, numbers / 2000, 0.5, normal=numbers.expand(3, -1, -1))
    given = replace(given, keep=lambda at: left if at else None, priors=[None, prior, prior])
    more = oversampled(given, 2)
    assert more.keep(0) is None and more.priors[0] is None and len(more.priors) == 3
    assert torch.equal(more.keep(1), left.repeat_interleave(2, 0).repeat_interleave(2, 1))
    twice = numbers.repeat_interleave(2, 0).repeat_interleave(2, 1)
    between = 0.5 + 0.002 * ((torch.arange(96.0) + 0.5) / 2 - 0.5).expand(72, -1)
    assert torch.allclose(more.priors[1].inverse[:, 1:-1], between[:, 1:-1])
    assert torch.equal(more.priors[1].normal[2], twice)
    assert torch.equal(more.priors[2].confidence, twice / 2000)
    made = TSDF(**LENGTHS, oversampling=1.5, trust=GeometricConsistency(priors="weigh", alone=1.0)).mesh(given)
    assert len(made.faces)
    assert oversampled(given, 1) is given


def test_large_pictures_are_not_magnified_beyond_what_fits(monkeypatch):
    small, large, huge = (look_at([2.0, 0, 0], size=size) for size in ((48, 36), (2000, 3000), (6000, 4000)))
    assert [(c.width, c.height) for c in (magnified(small, 2), magnified(small, 0.5))] == [(96, 72), (24, 18)]
    assert (magnified(large, 2).width, magnified(large, 2).height) == (2731, 4096)
    assert magnified(huge, 2) == huge and magnified(huge, 0.5).width == 3000
    told = []
    monkeypatch.setattr(oversampling, "emit", lambda event: told.append(event.text))
    given = subject([look_at([2.0, 0, 0])], torus, draw_of=lambda splats: None)
    views = [replace(given.views[0], camera=camera) for camera in (small, large, huge)]
    oversampled(replace(given, views=views[:1]), 2)
    assert not told
    oversampled(replace(given, views=views), 2)
    assert len(told) == 1 and told[0].startswith("mesh.oversampling 2 would make 2 of 3 depth maps")


def test_what_cannot_be_drawn_is_one_line():
    given = drawn(cameras((48, 36)), torus)
    with pytest.raises(BadInput, match="mesh.oversampling .*give 1"):
        TSDF(oversampling=2).mesh(replace(given, draw_of=None))
    with pytest.raises(BadInput, match="mesh.oversampling is 0"):
        TSDF(oversampling=0)
