"""Peak signal-to-noise ratio."""

from __future__ import annotations

from torch import Tensor

MIN_SQUARED_ERROR = 1e-10
"""Mean squared error at which PSNR ends, at 100 dB: equal images have a PSNR that JSON can hold."""


def psnr(render: Tensor, photo: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1, at most 100.

    Args:
        render: (3, H, W), or without a mask of any shape; clamped to [0, 1] first, as a screen shows it.
        photo: In [0, 1], of the same shape.
        mask: (H, W) bool, False where pixels do not count.
    """
    errors = (render.detach().clamp(0, 1).double() - photo.double()).square()
    error = errors.mean() if mask is None else errors[:, mask].mean()
    return float(-10 * error.clamp_min(MIN_SQUARED_ERROR).log10())
