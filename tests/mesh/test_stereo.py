"""Fusing depth priors alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh.stereo import Stereo
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Splats

from .shapes import around, seen, sphere, subject

NO_SPLATS = Splats("surfel", *(torch.zeros(0, *shape) for shape in ((3,), (4,), (2,), (), (1, 3))))


def stereo_subject(cameras, confidence=1.0, **changes):
    """Exact priors, and splats and renders that must not be looked at."""
    priors = []
    for camera in cameras:
        depth, normal = (torch.from_numpy(a).float() for a in seen(camera, sphere))
        inverse = torch.where(depth > 0, 1 / depth.clamp_min(1e-9), 0.0)
        priors.append(DepthPrior(inverse, torch.full_like(depth, confidence), 0.5, normal))
    photo = torch.tensor([10, 200, 30], dtype=torch.uint8)[:, None, None].expand(3, 72, 96)

    def never(view):
        raise AssertionError("the splats were drawn")

    given = {"priors": priors, "draw": never, "splats": NO_SPLATS, "photo": lambda at: photo}
    return subject(cameras, sphere, **(given | changes))


def test_photographs_without_a_prior_are_not_read():
    """A damaged photograph has no prior; to read it again would end the fusion. Where to look takes no photograph."""
    read, cameras = [], around(8)

    def photo(at):
        if at == 3:
            raise BadInput("damaged")
        read.append(at)
        return torch.zeros(3, 72, 96, dtype=torch.uint8)

    given = stereo_subject(cameras, photo=photo)
    given.priors[3] = None
    mesh = Stereo().mesh(given)
    assert len(mesh.faces) > 300
    assert sorted(read) == sorted([0, 1, 2, 4, 5, 6, 7] * 2), "for automatic lengths, and for the fusion"


def test_priors_alone_give_the_surface_and_photographs_its_colours():
    given = stereo_subject(around(20))
    mesh = Stereo().mesh(given)
    assert len(mesh.faces) > 1000 and np.abs(sphere(mesh.vertices)).max() < 0.02
    assert np.abs(mesh.colors.astype(int) - [10, 200, 30]).max() <= 1
    plain = TSDF().mesh(subject(around(20), sphere))
    assert mesh.facts == pytest.approx(plain.facts, rel=1e-5), "automatic lengths are those of the priors' depths"
    assert np.allclose(mesh.vertices, plain.vertices, atol=1e-4), "the same depth gives the same surface"


def test_what_is_not_confident_is_left_out():
    cameras = around(20)
    given = stereo_subject(cameras, confidence=0.3)
    with pytest.raises(BadInput, match="20 views .*0.375.*min_confidence of mesh:stereo"):
        Stereo().mesh(given)
    assert len(Stereo(min_confidence=0.3).mesh(given).faces) > 1000


def test_views_without_a_prior_tell_nothing():
    given = stereo_subject(around(20))
    some = [prior if at % 2 else None for at, prior in enumerate(given.priors)]
    mesh = Stereo(fusion=TSDF(voxel=0.4)).mesh(replace(given, priors=some, photo=None))
    assert np.abs(sphere(mesh.vertices)).max() < 0.02 and (np.abs(mesh.colors.astype(int) - 128) <= 1).all()


def test_without_priors_it_says_how_to_make_them():
    with pytest.raises(BadInput, match="surfkit prepare depth"):
        Stereo().mesh(stereo_subject(around(4), priors=None))
    with pytest.raises(BadInput, match="min_confidence is 0; .*more than 0"):
        Stereo(min_confidence=0)
