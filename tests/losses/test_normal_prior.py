"""Rendered normals against prior ones: exact geometry, numpy in double precision, finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.losses import NormalPrior
from surfkit.losses.base import Target, ignoring
from surfkit.primitives import Surfel2D
from surfkit.raster.api import Maps
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints, View
from surfkit.testing.synthetic import Flight, photograph

SIZE = (11, 14)
CAMERA = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 7.0, 5.5, SIZE[1], SIZE[0])


def scene(dtype=torch.float64) -> tuple[Maps, Target]:
    """Rendered and prior normals at random, both with holes."""
    draw = torch.Generator().manual_seed(0)
    prior, rendered = (torch.randn(3, *SIZE, generator=draw, dtype=dtype) for _ in range(2))
    prior = torch.nn.functional.normalize(prior, dim=0) * (torch.rand(SIZE, generator=draw) > 0.2)
    rendered = rendered * (torch.rand(SIZE, generator=draw) > 0.2)
    alpha, confidence = (torch.rand(SIZE, generator=draw, dtype=dtype) for _ in range(2))
    known = DepthPrior(torch.ones(SIZE), confidence, 1.0, prior)
    return Maps(alpha=alpha, normal=rendered), Target(View("a", CAMERA, None), torch.zeros(3, *SIZE), known)


@pytest.mark.parametrize("error", ["cosine", "l1", "both"])
def test_it_is_the_weighted_mean_over_pixels_that_have_both(error):
    maps, target = scene()
    total = weights = 0.0
    for i, j in np.ndindex(*SIZE):
        rendered, prior = maps.normal[:, i, j].numpy(), target.prior.normal[:, i, j].numpy()
        if rendered.any() and prior.any():
            rendered = rendered / np.linalg.norm(rendered)
            terms = {"cosine": 1 - rendered @ prior, "l1": np.abs(rendered - prior).sum()}
            weight = float(maps.alpha[i, j] * target.prior.confidence[i, j])
            total += weight * (sum(terms.values()) if error == "both" else terms[error])
            weights += weight
    assert weights > 1
    assert NormalPrior(error=error)(maps, target).item() == pytest.approx(total / weights, rel=1e-9)


@pytest.mark.parametrize("error", ["cosine", "l1", "both"])
def test_the_gradient_is_that_of_finite_differences_and_does_not_pull_alpha(error):
    maps, target = scene()
    normal, alpha = maps.normal.clone().requires_grad_(), maps.alpha.clone().requires_grad_()
    loss = NormalPrior(error=error)
    by_normal, by_alpha = torch.autograd.grad(
        loss(Maps(alpha=alpha, normal=normal), target), (normal, alpha), allow_unused=True
    )
    assert by_alpha is None and torch.isfinite(by_normal).all()
    without = (maps.normal == 0).all(0) | (target.prior.normal == 0).all(0)
    assert without.any() and not by_normal[:, without].any()
    draw = torch.Generator().manual_seed(1)
    way = torch.randn(3, *SIZE, generator=draw, dtype=torch.float64) * ~without
    ends = [loss(replace(maps, normal=maps.normal + h * way), target).item() for h in (-1e-6, 1e-6)]
    assert float((by_normal * way).sum()) == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-5)


def test_nothing_to_compare_is_no_loss():
    maps, target = scene()
    blank = replace(target.prior, normal=torch.zeros(3, *SIZE))
    drawn = replace(maps, color=torch.zeros(3, *SIZE))
    masked = ignoring(drawn, replace(target, mask=torch.zeros(SIZE, dtype=torch.bool)))[1]
    assert not masked.prior.normal.any(), "a mask hides normals too"
    for prior in (None, replace(target.prior, normal=None), blank, masked.prior):
        leaf = maps.normal.clone().requires_grad_()
        loss = NormalPrior()(Maps(alpha=maps.alpha, normal=leaf), replace(target, prior=prior))
        (grad,) = torch.autograd.grad(loss, leaf)
        assert loss.item() == 0 and not grad.any()


def test_rendered_surfels_that_lie_in_the_surface_agree_with_exact_normals():
    made = photograph(Flight(views=6, width=64, height=48, test_every=0))
    views, exact = made.scene.train, made.exact
    xyz, normals = [], []
    for view in views:
        camera, truth = view.camera, exact[view.name]
        there = truth.depth > 0
        points = (camera.rays(torch.float64) * truth.depth)[:, there]
        rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3:]
        xyz.append((rotation.T @ (points - shift)).T)
        normals.append((rotation.T @ truth.normal[:, there]).T)
    xyz, normals = (torch.cat(parts).float() for parts in (xyz, normals))
    primitive = Surfel2D(sh_degree=0)
    params = primitive.init(SparsePoints(xyz, torch.zeros(len(xyz), 3, dtype=torch.uint8), normals), torch.Generator())
    params["opacities"].fill_(4.0)
    view, truth = views[2], exact[views[2].name]
    maps = select("cpu")[0].render(primitive.activate(params, 0), view.camera, 0.005).maps
    assert (maps.alpha > 0.9).float().mean() > 0.5

    def loss(normal):
        prior = DepthPrior(torch.ones(48, 64), torch.ones(48, 64), 1.0, normal.float())
        return NormalPrior()(maps, Target(view, torch.zeros(3, 48, 64), prior)).item()

    turn = view.camera.world_to_camera[:3, :3].T
    assert loss(truth.normal) < 0.03
    assert loss(torch.einsum("ij,jhw->ihw", turn, truth.normal)) > 0.3, "normals in the axes of the world"
    assert loss(-truth.normal) > 1.9


def test_its_weight_may_stay_or_fall():
    assert [NormalPrior().weight_at(index, 300) for index in (1, 150, 300)] == pytest.approx([0.05] * 3)
    assert NormalPrior(start=0.1, end=0.001).weight_at(150, 300) == pytest.approx(0.01)
    with pytest.raises(BadInput, match="both must be above 0"):
        NormalPrior(end=0)
