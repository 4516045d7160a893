"""Spectra of the rendered view and of the photograph, from low frequencies to high ones (FreGS, Zhang et al. 2024)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput, require_within
from surfkit.core.schedule import Steps
from surfkit.losses.base import Loss, Target
from surfkit.raster.api import Maps

HIGHEST = math.sqrt(0.5)
"""Cycles per pixel of the highest frequency of a picture, in the corner of its spectrum."""
FAINT = 1 / 255 / math.sqrt(12)
"""Amplitude of the rounding of photographs to 8 bits, at each frequency (orthonormal transform). What is weaker has the
phase of its rounding, and its gradient, which goes with one over the amplitude, would outgrow all others."""


@dataclass(frozen=True)
class Frequency(Loss):
    """Differences of amplitude and phase between the spectra of the rendered view and of the photograph, of low
    frequencies first and then of ever higher ones (FreGS, Zhang et al. CVPR 2024, sections 3.2 and 3.3).

    With the spectra F of the photograph and F' of the rendering, d_a = sum | |F'| - |F| | / sqrt(HW) and d_p = sum
    | arg F' - arg F | / sqrt(HW) over the frequencies of a band. The term is (d_a + d_p) of the low band, of radii up
    to D_0; after step T_0 that of the high band is added, of radii from D_0 to D_t, which grows linearly from D_0 at
    step T_0 to the whole spectrum at step T. Large points that lie where the photograph has detail lack its high
    frequencies: the gradient of this term drives them to be split, as it is part of the signal of densification.

    The paper's weights, D_0, T_0 and T were not at hand; the defaults are choices of surfkit. Both sums are divided by
    the number of pixels, so that a weight means the same at all sizes; their ratio is the paper's. Differences of phase
    are taken the short way round, and the three colours are averaged. Frequencies whose amplitude is below the rounding
    of 8 bits, in either picture, have no phase here. A radius is in cycles per pixel, the same in all directions.
    """

    low: float = 1.0
    """Weight of the low band (w_l)."""

    high: float = 1.0
    """Weight of the high band (w_h)."""

    radius: float = 0.1
    """Highest frequency of the low band, cycles per pixel (D_0); 0.707 is the highest of a picture."""

    start: Steps = 500
    """Step after which the high band is added (T_0); by default that of the first edit of ADC."""

    full: Steps = 15_000
    """Step from which on the high band is all that is above the low one (T); by default that of the last edit of
    ADC."""

    def __post_init__(self) -> None:
        require_within({"low": (0, math.inf), "high": (0, math.inf), "radius": (0, HIGHEST)}, self)
        if not 0 <= self.start <= self.full:
            raise BadInput(f"the frequency loss has start {self.start} and full {self.full}; give 0 <= start <= full")

    def weight_at(self, index: int, steps: int) -> float:
        return float(self.low > 0 or (self.high > 0 and index > self.start))

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        color = maps.need("color")
        rendered, photo = (torch.fft.rfft2(image, norm="ortho") for image in (color, target.photo))
        radii, weights = bands(color)
        weights = weights * torch.where(radii <= self.radius, self.low, self.high * self._opened(radii, target.index))
        # Amplitudes of the transform of the paper, which is not orthonormal, are as many times as large.
        apart = amplitudes(rendered, photo) + phases(rendered, photo) / math.sqrt(color[0].numel())
        return (apart * weights).sum()

    def _opened(self, radii: Tensor, index: int) -> Tensor:
        """1 for the radii that belong to the high band in a step, 0 for the others."""
        if index <= self.start:
            return torch.zeros_like(radii)
        share = min(1.0, (index - self.start) / max(1, self.full - self.start))
        # The corner counts however its radius is rounded.
        highest = math.inf if share == 1 else self.radius + share * (HIGHEST - self.radius)
        return ((radii > self.radius) & (radii <= highest)).to(radii)


def bands(image: Tensor) -> tuple[Tensor, Tensor]:
    """The frequencies of a half spectrum of a real (C, H, W) picture, (H, W // 2 + 1) each: cycles per pixel, and the
    share of each in a mean over the whole spectrum and the C channels; the half that is left out mirrors this one."""
    channels, height, width = image.shape
    down = torch.fft.fftfreq(height, device=image.device, dtype=image.dtype)
    across = torch.fft.rfftfreq(width, device=image.device, dtype=image.dtype)
    twice = torch.full_like(across, 2.0)
    twice[0] = 1.0
    if width % 2 == 0:
        twice[-1] = 1.0
    return torch.hypot(down[:, None], across), twice.expand(height, -1) / (channels * height * width)


def amplitudes(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of the amplitudes of two spectra, of the same shape."""
    return (a.abs() - b.abs()).abs()


def phases(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences, from 0 to pi, of the phases of two spectra, of the same shape; 0 where either amplitude is
    `FAINT` or less."""
    known = (a.abs() > FAINT) & (b.abs() > FAINT)
    turned = torch.where(known, a, 1) * torch.where(known, b, 1).conj()
    return turned.angle().abs()
