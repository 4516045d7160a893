"""Depth regression against an evaluation in numpy, in double precision."""

import math

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.losses import DepthRegression
from surfkit.losses.base import Sample
from surfkit.raster.api import Maps
from surfkit.raster.ssim import ssim_reference
from surfkit.scene.camera import Camera
from surfkit.scene.depth_prior import DepthPrior
from surfkit.scene.scene import View

SIZE = (19, 23)
TYPICAL = 0.7


def scene(seed: int = 0, unit: float = 1.0) -> tuple[torch.Tensor, Sample]:
    """A rendered median depth and a prior, both with holes, in any unit of length."""
    draw = torch.Generator().manual_seed(seed)
    median = unit * (1 + torch.rand(SIZE, generator=draw))
    median[torch.rand(SIZE, generator=draw) < 0.2] = 0
    inverse = (0.5 + torch.rand(SIZE, generator=draw)) / unit
    inverse[torch.rand(SIZE, generator=draw) < 0.2] = 0
    prior = DepthPrior(inverse, torch.rand(SIZE, generator=draw) * (inverse > 0), TYPICAL / unit)
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 11.0, 9.0, SIZE[1], SIZE[0])
    return median, Sample(View("a", camera, None), torch.zeros(3, *SIZE), prior)


def masked(median: torch.Tensor, prior: DepthPrior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights, and both inverse depths in units of the typical one, float64."""
    d, p, w = (t.double().numpy() for t in (median, prior.inverse, prior.confidence))
    there = (d > 0) & (p > 0)
    return w * there, 1 / np.where(there, d, 1) / prior.typical, p / prior.typical


def test_l1_is_the_mean_over_trusted_pixels():
    median, sample = scene()
    weight, rendered, estimated = masked(median, sample.prior)
    wanted = (weight * np.abs(rendered - estimated)).sum() / weight.sum()
    assert DepthRegression()(Maps(median=median), sample).item() == pytest.approx(wanted, rel=1e-5)


def test_ssim_is_that_of_the_masked_maps():
    median, sample = scene()
    weight, rendered, estimated = masked(median, sample.prior)
    maps = [torch.from_numpy(weight * values)[None] for values in (rendered, estimated)]
    wanted = 1 - ssim_reference(*maps).item()
    assert DepthRegression(error="ssim")(Maps(median=median), sample).item() == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("error", ["l1", "ssim"])
def test_no_unit_of_length_matters(error):
    values = [
        DepthRegression(error=error)(Maps(median=m), s).item() for m, s in (scene(unit=u) for u in (1, 1e3, 1e-3))
    ]
    assert values[1:] == pytest.approx(values[:1] * 2, rel=1e-4)


@pytest.mark.parametrize("error", ["l1", "ssim"])
def test_the_gradient_is_that_of_finite_differences_and_zero_at_masked_pixels(error):
    median, sample = scene()
    leaf = median.clone().requires_grad_()
    DepthRegression(error=error)(Maps(median=leaf), sample).backward()
    hidden = (median == 0) | (sample.prior.inverse == 0)
    assert torch.isfinite(leaf.grad).all() and (leaf.grad[hidden] == 0).all() and (leaf.grad[~hidden] != 0).any()
    weight, rendered, estimated = masked(median, sample.prior)
    if error == "l1":
        by_depth = weight * np.sign(rendered - estimated) * -(rendered**2) * TYPICAL / weight.sum()
        np.testing.assert_allclose(leaf.grad.numpy(), by_depth, rtol=1e-4, atol=1e-8)


def test_nothing_to_compare_is_no_loss():
    median, sample = scene()
    blank = DepthPrior(torch.zeros(SIZE), torch.zeros(SIZE), TYPICAL)
    for error in ("l1", "ssim"):
        for depth, prior in ((torch.zeros(SIZE), sample.prior), (median, blank), (median, None)):
            leaf = depth.clone().requires_grad_()
            loss = DepthRegression(error=error)(Maps(median=leaf), Sample(sample.view, sample.photo, prior))
            loss.backward()
            assert loss.item() == pytest.approx(0, abs=1e-6) and not leaf.grad.any()


def test_the_weight_falls_exponentially():
    loss = DepthRegression()
    assert loss.weight_at(0, 30_000) == pytest.approx(0.5) and loss.weight_at(30_000, 30_000) == pytest.approx(0.0025)
    for index in (1, 7_000, 15_000):
        assert loss.weight_at(index, 30_000) == pytest.approx(0.5 * math.exp(math.log(0.005) * index / 30_000))
    with pytest.raises(BadInput, match="both must be above 0"):
        DepthRegression(end=0)
