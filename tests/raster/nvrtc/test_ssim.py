"""The kernels of structural similarity against plain torch in float64."""

import pytest
import torch
from torch import Tensor

from surfkit.raster.cuda.cuda_ssim import SSIM_SOURCE, backward, forward
from surfkit.raster.nvrtc.modules import Kernels
from surfkit.raster.ssim import ssim_reference

SIZES = [(1, 1, 1), (3, 1, 70), (2, 40, 1), (3, 16, 32), (1, 17, 33), (3, 11, 50), (4, 37, 5)]
"""One pixel wide or high, whole tiles and one more, several channels, smaller than the window."""


def photographs(size: tuple[int, int, int], kind: str) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(sum(size))
    x, y = torch.rand(2, *size, generator=draw)
    if kind == "close":
        x = (y + 0.05 * torch.randn(size, generator=draw)).clamp(0, 1)
    if kind == "black":
        x, y = torch.zeros(size), torch.zeros(size)
    return x, y


def launched(on: Kernels, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """The mean similarity, and 0.3 times its gradient."""
    x, y = x.to(on.device), y.to(on.device)
    value, derivatives = forward(x, y, True, on)
    return value.cpu(), backward(x, y, derivatives, torch.tensor(0.3).to(x), on).cpu()


@pytest.mark.parametrize("kind", ["noise", "close", "black"])
@pytest.mark.parametrize("size", SIZES)
def test_agrees_with_plain_torch(load, size, kind):
    x, y = photographs(size, kind)
    on = load(SSIM_SOURCE)
    value, gradient = launched(on, x, y)
    exact = x.double().requires_grad_()
    expected = ssim_reference(exact, y.double())
    (expected_gradient,) = torch.autograd.grad(0.3 * expected, exact)
    assert value.dtype == torch.float32 and abs(float(value) - expected.item()) <= 1e-5
    # Of equal images the gradient is 0 by cancellation of terms of the size of one over the number of values.
    error = (gradient - expected_gradient).norm()
    assert error <= 1e-4 * expected_gradient.norm() + 1e-7 / x.numel() ** 0.5


def test_without_gradient():
    x, y = photographs((3, 20, 40), "noise")
    value, derivatives = forward(x, y, False)
    assert all(each.numel() == 0 for each in derivatives)
    assert torch.equal(value, forward(x, y, True)[0])
