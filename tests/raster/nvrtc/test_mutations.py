"""Mistakes put into the kernels of surfkit: each makes the emulator report it, or the result wrong."""

import pytest
import torch

from surfkit.raster.cuda import cuda_ssim as ssim
from surfkit.raster.nvrtc.emulated import Emulated, KernelError
from surfkit.raster.ssim import ssim_reference
from surfkit.train import adam

from .sources import changed

BARRIER = "__syncthreads();"
SSIM = {
    "no barrier before blurring across": (BARRIER, "", 0, "of the block has written|with no barrier"),
    "no barrier before blurring down": (BARRIER, "", 1, "of the block has written|with no barrier"),
    "no barrier before the sum of the warps": (BARRIER, "", 2, "of the block has written|with no barrier"),
    "no barrier before blurring derivatives": (BARRIER, "", 3, "of the block has written|with no barrier"),
    "no barrier before blurring them down": (BARRIER, "", 4, "of the block has written|with no barrier"),
    "every lane writes the sum of its warp": ("threadIdx.x % 32 == 0", "true", 0, "with no barrier"),
    "all blocks write one sum": ("sums[block]", "sums[0]", 0, "a thread of another block writes"),
    "one row too many": ("py >= height", "py > height", 0, "a thread of another block|index .* which has"),
    "one column too many": ("px >= width", "px > width", 1, "with no barrier|another block|index .* which has"),
    "one column too many of the image": ("x < at.width", "x <= at.width", 0, "index .* which has|wrong"),
    "a tile too small": ("tile, 2 * kTile)", "tile, 2 * kTile - 2)", 0, "index .* of tile, which has"),
    "a barrier that some threads pass by": (
        "if (threadIdx.x % 32 == 0) warps",
        "if (threadIdx.x > 99) return; if (threadIdx.x % 32 == 0) warps",
        0,
        "waits in __syncthreads .* which has returned",
    ),
    "a window that is not symmetric": ("kRadius - i : i - kRadius", "kRadius - i : i - kRadius - (i > 7)", 0, "wrong"),
}


def similarity(source) -> None:
    """Raise KernelError if the kernels do, or if they give something else than plain torch."""
    x, y = torch.rand(2, 2, 35, 40, generator=torch.Generator().manual_seed(0))
    on = Emulated(source)
    value, derivatives = ssim.forward(x, y, True, on)
    gradient = ssim.backward(x, y, derivatives, torch.tensor(1.0), on)
    exact = x.double().requires_grad_()
    (expected,) = torch.autograd.grad(ssim_reference(exact, y.double()), exact)
    if not (gradient - expected).norm() <= 1e-4 * expected.norm():
        raise KernelError("wrong")


def test_right_as_it_is():
    similarity(ssim.SSIM_SOURCE)


@pytest.mark.parametrize("name", SSIM)
def test_mistakes_in_similarity(name):
    old, new, skip, message = SSIM[name]
    with pytest.raises(KernelError, match=message):
        similarity(changed(ssim.SSIM_SOURCE, old, new, skip=skip))


def test_mistakes_in_adam():
    source = changed(adam.ADAM_SOURCE, "i >= gradient.size", "i > gradient.size")
    tensors = [torch.rand(100) for _ in range(4)]
    with pytest.raises(KernelError, match="index 100 of gradient, .*100 elements"):
        adam.launch_update(Emulated(source), *tensors, 0.1, 1)
