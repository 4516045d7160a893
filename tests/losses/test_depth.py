"""Depth regression against an evaluation in numpy, in double precision."""

import math

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.losses import DepthRegression
from surfkit.losses.base import Target
from surfkit.raster.api import Maps
from surfkit.raster.ssim import ssim_map
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.testing import check_loss

SIZE = (19, 23)
TYPICAL = 0.7


def scene(seed: int = 0, unit: float = 1.0) -> tuple[torch.Tensor, Target]:
    """A rendered median depth and a prior, both with holes, in any unit of length."""
    draw = torch.Generator().manual_seed(seed)
    median = unit * (1 + torch.rand(SIZE, generator=draw))
    median[torch.rand(SIZE, generator=draw) < 0.2] = 0
    inverse = (0.5 + torch.rand(SIZE, generator=draw)) / unit
    inverse[torch.rand(SIZE, generator=draw) < 0.2] = 0
    prior = DepthPrior(inverse, torch.rand(SIZE, generator=draw) * (inverse > 0), TYPICAL / unit)
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 11.0, 9.0, SIZE[1], SIZE[0])
    return median, Target(View("a", camera, None), torch.zeros(3, *SIZE), prior)


def masked(median: torch.Tensor, prior: DepthPrior) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights, and both inverse depths in units of the typical one, float64."""
    d, p, w = (t.double().numpy() for t in (median, prior.inverse, prior.confidence))
    there = (d > 0) & (p > 0)
    return w * there, 1 / np.where(there, d, 1) / prior.typical, p / prior.typical


def test_l1_is_the_mean_over_trusted_pixels():
    median, target = scene()
    weight, rendered, estimated = masked(median, target.prior)
    wanted = (weight * np.abs(rendered - estimated)).sum() / weight.sum()
    assert DepthRegression()(Maps(median=median), target).item() == pytest.approx(wanted, rel=1e-5)


def test_ssim_is_the_mean_over_trusted_pixels_too():
    median, target = scene()
    weight, rendered, estimated = masked(median, target.prior)
    there = (median.numpy() > 0) & (target.prior.inverse.numpy() > 0)
    similar = ssim_map(*(torch.from_numpy(there * values)[None] for values in (rendered, estimated)))[0].numpy()
    wanted = (weight * (1 - similar)).sum() / weight.sum()
    assert DepthRegression(error="ssim")(Maps(median=median), target).item() == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("error", ["l1", "ssim"])
def test_pixels_without_an_estimate_do_not_dilute_the_error(error):
    size, shift = (40, 60), 1.3
    median = torch.full(size, 2.0)
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 30.0, 20.0, size[1], size[0])
    view, photo = View("a", camera, None), torch.zeros(3, *size)
    values = []
    for confidence in (1.0, 0.25):
        for columns in (60, 30):  # half of the pixels are known, and those are as wrong as before
            known = torch.zeros(size)
            known[:, :columns] = 1.0
            prior = DepthPrior(known * shift / 2, known * confidence, 0.5)
            values.append(DepthRegression(error=error)(Maps(median=median), Target(view, photo, prior)).item())
    assert values == pytest.approx(values[:1] * 4, rel=0.1 if error == "ssim" else 1e-5)  # rims have their say


@pytest.mark.parametrize("error", ["l1", "ssim"])
def test_the_expected_depth_is_compared_and_read_where_it_is_asked_for(error):
    median, target = scene()
    expected, _ = scene(seed=1)
    alpha = torch.where(expected > 0, 0.8, 0.0)
    loss = DepthRegression(error=error, depth="expected")
    assert set(loss.reads) == {"alpha", "depth"} and DepthRegression(error=error).reads == ("median",)
    maps = Maps(alpha=alpha, depth=alpha * expected)
    found = loss(maps, target).item()
    assert found == pytest.approx(DepthRegression(error=error)(Maps(median=expected), target).item(), rel=1e-5)
    assert found != pytest.approx(DepthRegression(error=error)(Maps(median=median), target).item(), rel=1e-2)
    check_loss(loss, SIZE)


@pytest.mark.parametrize("error", ["l1", "ssim"])
def test_no_unit_of_length_matters(error):
    values = [
        DepthRegression(error=error)(Maps(median=m), s).item() for m, s in (scene(unit=u) for u in (1, 1e3, 1e-3))
    ]
    assert values[1:] == pytest.approx(values[:1] * 2, rel=1e-4)


@pytest.mark.parametrize("error", ["l1", "ssim"])
def test_the_gradient_is_that_of_finite_differences_and_zero_at_masked_pixels(error):
    median, target = scene()
    leaf = median.clone().requires_grad_()
    DepthRegression(error=error)(Maps(median=leaf), target).backward()
    hidden = (median == 0) | (target.prior.inverse == 0)
    assert torch.isfinite(leaf.grad).all() and (leaf.grad[hidden] == 0).all() and (leaf.grad[~hidden] != 0).any()
    weight, rendered, estimated = masked(median, target.prior)
    if error == "l1":
        by_depth = weight * np.sign(rendered - estimated) * -(rendered**2) * TYPICAL / weight.sum()
        np.testing.assert_allclose(leaf.grad.numpy(), by_depth, rtol=1e-4, atol=1e-8)


def test_nothing_to_compare_is_no_loss():
    median, target = scene()
    blank = DepthPrior(torch.zeros(SIZE), torch.zeros(SIZE), TYPICAL)
    for error in ("l1", "ssim"):
        for depth, prior in ((torch.zeros(SIZE), target.prior), (median, blank), (median, None)):
            leaf = depth.clone().requires_grad_()
            loss = DepthRegression(error=error)(Maps(median=leaf), Target(target.view, target.photo, prior))
            loss.backward()
            assert loss.item() == pytest.approx(0, abs=1e-6) and not leaf.grad.any()


def test_the_weight_falls_exponentially():
    loss = DepthRegression()
    assert loss.weight_at(0, 30_000) == pytest.approx(0.5) and loss.weight_at(30_000, 30_000) == pytest.approx(0.0025)
    for index in (1, 7_000, 15_000):
        assert loss.weight_at(index, 30_000) == pytest.approx(0.5 * math.exp(math.log(0.005) * index / 30_000))
    with pytest.raises(BadInput, match="both must be above 0"):
        DepthRegression(end=0)


def test_the_weight_may_stay_or_rise():
    constant, rising = DepthRegression(start=10.0, end=10.0), DepthRegression(start=0.5, end=2.0)
    assert [constant.weight_at(index, 700) for index in range(701)] == pytest.approx([10.0] * 701, rel=1e-12)
    assert [rising.weight_at(index, 100) for index in (0, 50, 100)] == pytest.approx([0.5, 1.0, 2.0])
