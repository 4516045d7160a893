"""Structural similarity against convolutions of scipy in float64."""

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.raster import native
from surfkit.raster.ssim import ssim, ssim_reference

from .scenes import Draw

SIZES = [(3, 47, 61), (1, 11, 11), (3, 5, 64), (2, 1, 1), (3, 3, 40), (3, 16, 16), (1, 33, 7), (3, 130, 70)]


def expected(x: np.ndarray, y: np.ndarray) -> float:
    """Wang et al. 2004 with a Gaussian window of 11 x 11, sigma 1.5, zeros outside."""
    from scipy.ndimage import convolve

    ticks = np.arange(11) - 5
    window = np.exp(-(ticks[:, None] ** 2 + ticks[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()

    def mean(image: np.ndarray) -> np.ndarray:
        return np.stack([convolve(channel, window, mode="constant") for channel in image])

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return float(((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean())


# A variance is the difference of two means, in float32 wrong by some 1e-7, of which 1e-7 / C2 = 1e-4 is left where an
# image is flat. Plain torch in float32 is as far off.
VALUE = {"noise": 1e-6, "close": 1e-6, "flat": 2e-4, "black": 1e-6}
GRADIENT = {"noise": 1e-6, "close": 3e-5, "flat": 2e-4, "black": 1e-6}


def close(found: torch.Tensor, true: torch.Tensor, kind: str) -> bool:
    """Of equal images the gradient is 0 by cancellation of terms of the size of one over the number of values."""
    return bool((found - true).norm() <= GRADIENT[kind] * true.norm() + 1e-6 / found.numel() ** 0.5)


def images(size, kind: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Two images, float32: noise, a photograph and its noisy copy, equal or flat ones."""
    draws = Draw(sum(size))
    x, y = draws.uniform(0, 1, *size), draws.uniform(0, 1, *size)
    if kind == "close":
        ramp = torch.linspace(0, 6, size[2]).sin().double() * torch.linspace(0.2, 1, size[1]).double()[:, None]
        y = (0.5 + 0.4 * ramp).expand(size).contiguous()
        x = (y + 0.05 * draws.normal(*size)).clamp(0, 1)
    if kind == "flat":
        x, y = torch.full(size, 0.3), torch.full(size, 0.8)
    if kind == "black":
        x, y = torch.zeros(size), torch.zeros(size)
    return x.float(), y.float()


each = pytest.mark.parametrize("kind", ["noise", "close", "flat", "black"])
each_size = pytest.mark.parametrize("size", SIZES)


@each
@each_size
def test_value_equals_scipy(size, kind):
    x, y = images(size, kind)
    value = expected(x.double().numpy(), y.double().numpy())
    assert ssim(x, y).item() == pytest.approx(value, abs=VALUE[kind])
    assert ssim_reference(x.double(), y.double()).item() == pytest.approx(value, abs=1e-12)


@each
@each_size
def test_gradient_equals_the_reference_in_float64(size, kind):
    x, y = images(size, kind)
    x.requires_grad_()
    (3 * ssim(x, y)).backward()
    exact = x.detach().double().requires_grad_()
    (3 * ssim_reference(exact, y.double())).backward()
    assert close(x.grad, exact.grad, kind)
    assert x.grad.dtype == torch.float32


def test_gradient_of_the_reference_equals_finite_differences():
    x, y = images((2, 6, 13), "close")
    exact = x.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda image: ssim_reference(image, y.double()), (exact,))
    value = ssim_reference(exact, y.double())
    (gradient,) = torch.autograd.grad(value, exact)
    for at in ((0, 0, 0), (1, 3, 7), (0, 5, 12)):
        step = np.zeros(exact.shape)
        step[at] = 1e-5
        pair = [expected(exact.detach().numpy() + s * step, y.double().numpy()) for s in (1, -1)]
        assert gradient[at].item() == pytest.approx((pair[0] - pair[1]) / 2e-5, rel=1e-5, abs=1e-9)


def test_an_image_is_similar_to_itself():
    x, _ = images((3, 40, 50), "noise")
    assert ssim(x, x).item() == pytest.approx(1, abs=1e-6)


def test_no_gradient_is_made_where_none_is_wanted():
    x, y = images((3, 20, 20), "noise")
    assert not ssim(x, y).requires_grad
    with torch.no_grad():
        assert ssim(x.requires_grad_(), y).item() == pytest.approx(ssim_reference(x, y).item(), abs=1e-6)


def test_slices_of_larger_images_are_read_as_they_lie():
    x, y = images((3, 40, 50), "close")
    part = (slice(None), slice(3, 31), slice(7, 46))
    value = expected(x[part].double().numpy(), y[part].double().numpy())
    assert ssim(x[part], y[part]).item() == pytest.approx(value, abs=1e-6)
    assert ssim(x[part], y[part].double()).item() == pytest.approx(value, abs=1e-6)


@needs_native
@each
def test_every_compilation_agrees(kind):
    x, y = images((3, 47, 61), kind)
    value, before = expected(x.double().numpy(), y.double().numpy()), native.module().kernels_in_use()
    exact = x.double().requires_grad_()
    ssim_reference(exact, y.double()).backward()
    try:
        for name in native.module().kernels():
            native.module().use_kernels(name)
            image = x.clone().requires_grad_()
            made = ssim(image, y)
            made.backward()
            assert made.item() == pytest.approx(value, abs=VALUE[kind]), name
            assert close(image.grad, exact.grad, kind), name
    finally:
        native.module().use_kernels(before)


def test_without_the_compiled_module_the_reference_answers(monkeypatch):
    x, y = images((3, 20, 20), "noise")
    fused = ssim(x, y).item()
    monkeypatch.setattr(native, "module", lambda: None)
    assert ssim(x, y).item() == pytest.approx(fused, abs=1e-6)
