"""Spectra: pictures that differ in one known frequency, and sums over the whole spectrum in numpy, double precision."""

import math

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.core.schedule import rescale
from surfkit.losses.base import Target, ignoring
from surfkit.losses.frequency import FAINT, HIGHEST, Frequency
from surfkit.raster.api import Maps
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View
from surfkit.testing import check_loss

SIZES = [(24, 36), (25, 31), (8, 1)]
LATE = 1_000_000


def target(photo: torch.Tensor, index: int = LATE, mask: torch.Tensor | None = None) -> Target:
    height, width = photo.shape[1:]
    camera = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, width / 2, height / 2, width, height)
    return Target(View("a", camera, None), photo, mask=mask, index=index)


def picture(size: tuple[int, int], seed: int = 0) -> torch.Tensor:
    return torch.rand(3, *size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def wave(size: tuple[int, int], down: int, across: int, shift: float = 0.0) -> torch.Tensor:
    """(3, H, W) a cosine of so many whole cycles along the sides."""
    y, x = torch.meshgrid(*(torch.arange(float(n), dtype=torch.float64) / n for n in size), indexing="ij")
    return (2 * math.pi * (down * y + across * x) + shift).cos().expand(3, *size)


def by_hand(loss: Frequency, color: torch.Tensor, photo: torch.Tensor, index: int) -> float:
    """The formulas of the paper, frequency by frequency of the whole spectrum, over the number of pixels."""
    channels, height, width = color.shape
    total = 0.0
    for channel in range(channels):
        one, other = (np.fft.fft2(image[channel].numpy()) for image in (color, photo))
        for u in range(height):
            for v in range(width):
                radius = math.hypot(min(u, height - u) / height, min(v, width - v) / width)
                opened = max(0.0, min(1.0, (index - loss.start) / (loss.full - loss.start)))
                limit = loss.radius + opened * (HIGHEST - loss.radius)
                weight = loss.low if radius <= loss.radius else loss.high if radius <= limit + 1e-12 else 0.0
                a, b = one[u, v], other[u, v]
                phase = abs((np.angle(a) - np.angle(b) + math.pi) % (2 * math.pi) - math.pi)
                if min(abs(a), abs(b)) <= FAINT * math.sqrt(height * width):
                    phase = 0.0
                total += weight * (abs(abs(a) - abs(b)) + phase)
    return total / math.sqrt(height * width) / (channels * height * width)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("index", [0, 500, 501, 4_000, 15_000, 30_000])
def test_it_is_the_sum_over_the_spectrum(size, index):
    loss, color, photo = Frequency(low=0.3, high=0.7), picture(size), picture(size, 1)
    found = loss(Maps(color=color), target(photo, index)).item()
    assert found == pytest.approx(by_hand(loss, color, photo, index), rel=1e-9)


@pytest.mark.parametrize(("down", "across"), [(1, 0), (2, 3), (0, 12), (8, 12)])
def test_a_wave_of_another_height_costs_its_amplitude_and_a_shifted_one_its_phase(down, across):
    size = (24, 36)
    pixels, loss = size[0] * size[1], Frequency(low=1.0, high=1.0)
    photo = wave(size, down, across)
    # A cosine of amplitude A has two spectral lines of A HW / 2, over sqrt(HW) and over HW here.
    taller = loss(Maps(color=1.25 * photo), target(photo)).item()
    assert taller == pytest.approx(0.25 / math.sqrt(pixels), rel=1e-9)
    shifted = loss(Maps(color=wave(size, down, across, 0.4)), target(photo)).item()
    assert shifted == pytest.approx(2 * 0.4 / math.sqrt(pixels) / pixels, rel=1e-6)


def test_the_high_band_opens_linearly_from_its_lower_end():
    size, loss = (64, 64), Frequency(low=0.0, high=1.0, radius=0.125, start=100, full=900)
    photo = torch.zeros(3, *size, dtype=torch.float64)
    for down, across in [(10, 0), (0, 20), (30, 9), (32, 32)]:
        share = (math.hypot(down, across) / 64 - 0.125) / (HIGHEST - 0.125)
        enters = 100 + share * 800
        color = wave(size, down, across)
        before, after = (
            loss(Maps(color=color), target(photo, at)).item() for at in (math.floor(enters) - 1, math.ceil(enters) + 1)
        )
        assert before < 1e-12 and after > 1e-3
    low = wave(size, 8, 0)  # a radius of just D_0 belongs to the low band, in all steps
    assert loss(Maps(color=low), target(photo)).item() < 1e-12
    other = Frequency(low=1.0, high=0.0, radius=0.125)
    assert other(Maps(color=low), target(photo, 0)).item() > 1e-3
    assert other(Maps(color=wave(size, 9, 0)), target(photo)).item() < 1e-12


def test_gradients_are_those_of_finite_differences():
    size, loss = (6, 7), Frequency(low=1.0, high=1.0)
    photo, leaf = picture(size), picture(size, 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda color: loss(Maps(color=color), target(photo)), (leaf,))
    early = target(photo, 4_000)
    assert torch.autograd.gradcheck(lambda color: loss(Maps(color=color), early), (leaf,))


def test_what_is_as_in_the_photograph_costs_nothing_and_is_left_alone():
    photo = picture((24, 36)).float()
    leaf = photo.clone().requires_grad_()
    value = Frequency()(Maps(color=leaf), target(photo))
    value.backward()
    assert value.item() == 0 and leaf.grad.abs().max() == 0


def test_flat_pictures_have_no_phase_that_could_pull():
    """What is left of a flat picture's spectrum is rounding; one over its amplitude would be a huge gradient."""
    leaf = torch.full((3, 33, 47), 0.3).requires_grad_()
    Frequency(low=1.0, high=1.0)(Maps(color=leaf), target(torch.full((3, 33, 47), 0.6))).backward()
    assert leaf.grad.abs().max() < 0.01


def test_masked_pixels_do_not_learn():
    mask = torch.ones(24, 36, dtype=torch.bool)
    mask[4:12, 5:20] = False
    leaf = picture((24, 36)).requires_grad_()
    Frequency()(*ignoring(Maps(color=leaf), target(picture((24, 36), 1), mask=mask))).backward()
    assert (leaf.grad[:, ~mask] == 0).all() and (leaf.grad[:, mask] != 0).all()


def test_it_keeps_the_contract_of_a_loss_and_its_schedule_scales():
    check_loss(Frequency())
    check_loss(Frequency(), (5, 7))
    assert Frequency().weight_at(1, 10) == 1 and Frequency(low=0, high=0).weight_at(1, 10) == 0
    late = Frequency(low=0, start=5, full=8)
    assert [late.weight_at(index, 10) for index in (5, 6)] == [0, 1], "no transform where nothing counts"
    short = rescale(Frequency(), 0.01)
    assert (short.start, short.full, short.radius) == (5, 150, Frequency().radius)


@pytest.mark.parametrize(
    "wrong", [{"low": -1.0}, {"high": math.inf * 0}, {"radius": 0.8}, {"start": 10, "full": 5}, {"start": -1}]
)
def test_settings_that_mean_nothing_are_refused(wrong):
    with pytest.raises(BadInput):
        Frequency(**wrong)
