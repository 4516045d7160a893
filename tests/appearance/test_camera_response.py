from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.polynomial import legendre

from surfkit.appearance import CameraResponse
from surfkit.appearance.camera_response import responded, sensor_axes
from surfkit.raster import native
from surfkit.scene.camera import Camera
from surfkit.scene.response import curve_slope, curved
from surfkit.scene.srgb import from_linear, linear

POSE = torch.eye(4, dtype=torch.float64)
CAMERA = Camera(POSE, 30.0, 30.0, 16.5, 11.0, 37, 23)
NUMBERS = torch.tensor([0.6, -0.4, 0.2, 0.5, 0.3, -0.1, 0.05, -0.03, 0.3, -0.2, 0.15])
KERNELS = [*(native.module().kernels() if native.module() else ()), None]


def expected(color, numbers, camera):
    """(3, H, W) by the words of the class, with the functions of scene.srgb and of numpy."""
    stops, (a, b, c), centre, curve = numbers[:3], numbers[3:6], numbers[6:8], numbers[8:]
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    half = np.hypot(camera.width, camera.height) / 2
    r2 = ((x - camera.cx) / half - centre[0]) ** 2 + ((y - camera.cy) / half - centre[1]) ** 2
    light = linear(color) * 2 ** (stops[:, None, None] - (a * r2 + b * r2**2 + c * r2**3))
    encoded = from_linear(light.clip(max=1))
    series = legendre.legint(np.array([0.0, *curve]), lbnd=1)  # of u = 1 - 2 value, from u = 1 on
    return encoded - legendre.legval(1 - 2 * encoded, series) / 2


def colors(seed=0):
    draw = torch.Generator().manual_seed(seed)
    color = torch.rand(3, CAMERA.height, CAMERA.width, generator=draw)
    color[:, :8] *= 0.08  # around the end of the straight part of sRGB
    return color


@pytest.fixture(params=KERNELS, ids=str)
def kernels(request, monkeypatch):
    """Each compilation of the kernels, and torch without them."""
    if request.param is None:
        monkeypatch.setattr(native, "module", lambda: None)
        yield
        return
    used = native.kernels().kernels_in_use()
    native.kernels().use_kernels(request.param)
    yield
    native.kernels().use_kernels(used)


def test_it_begins_by_changing_nothing():
    model = CameraResponse()
    assert torch.allclose(model(model.begin(3)[1], colors(), CAMERA), colors(), atol=1e-6)


def test_colours_are_those_of_the_formula(kernels):
    for numbers in (NUMBERS, -NUMBERS, torch.cat([3 * NUMBERS[:8], torch.zeros(3)])):
        got = CameraResponse()(numbers, colors(), CAMERA)
        want = expected(colors().double().numpy(), numbers.double().numpy(), CAMERA)
        assert np.abs(got.numpy() - want).max() < 2e-6


def test_gradients_are_differences_of_the_formula(kernels):
    color, step = colors().double(), 1e-6
    given = color.float().requires_grad_()
    shown = CameraResponse()(NUMBERS, given, CAMERA)
    (grad,) = torch.autograd.grad(shown.sum(), given)
    ends = [expected((color + sign * step).numpy(), NUMBERS.double().numpy(), CAMERA) for sign in (1, -1)]
    smooth = (shown.detach() < 0.999).numpy() & ((color - 0.04045).abs() > 1e-3).numpy()
    smooth &= (torch.from_numpy(ends[0]) - 0.04045).abs().numpy() > 0.02  # the derivative of sRGB jumps there, by 1 %
    slope = (ends[0] - ends[1]) / (2 * step)
    assert smooth.mean() > 0.5 and np.abs(grad.numpy() - slope)[smooth].max() < 1e-3


def test_what_is_white_already_is_made_darker_and_not_brighter(kernels):
    color = torch.full((3, CAMERA.height, CAMERA.width), 0.95).requires_grad_()
    shown = CameraResponse()(torch.tensor([1.0] * 3 + [0.0] * 8), color, CAMERA)
    assert torch.equal(shown, torch.ones_like(shown))
    darker, brighter = (torch.autograd.grad(shown, color, sign * torch.ones_like(shown), True)[0] for sign in (1, -1))
    assert (darker > 0.5).all() and not brighter.any()


def test_values_below_0_go_on_straight(kernels):
    color = torch.full((3, CAMERA.height, CAMERA.width), -0.02)
    shown = CameraResponse()(torch.tensor([1.0, 0.0, -1.0] + [0.0] * 8), color, CAMERA)
    assert torch.allclose(shown[:, 0, 0], torch.tensor([-0.04, -0.02, -0.01]), atol=1e-6)


def test_double_precision_is_kept():
    axes = sensor_axes(CAMERA, colors().double())
    want = expected(colors().double().numpy(), NUMBERS.double().numpy(), CAMERA)
    assert np.abs(responded(colors().double(), NUMBERS.double(), *axes)[0].numpy() - want).max() < 1e-7


def test_a_smaller_picture_of_the_same_camera_has_the_same_dark_corners():
    grey, model = torch.full((3, 230, 370), 0.5), CameraResponse()
    large = model(NUMBERS, grey, CAMERA.resized(370, 230))
    small = model(NUMBERS, grey[:, :23, :37], CAMERA)
    middle = large.unfold(1, 10, 10).unfold(2, 10, 10)[..., 4:6, 4:6].mean((-1, -2))  # around the same places
    assert torch.allclose(middle, small, atol=2e-4)
    assert small[:, 0, 0].sum() < small[:, 11, 16].sum() - 0.2


def test_curves_are_monotone_between_fixed_ends():
    at, draw = np.linspace(0, 1, 1001), np.random.default_rng(0)
    for _ in range(50):
        curve = draw.normal(size=3)
        curve *= 0.9 / np.abs(curve).sum()
        values = curved(at, curve)
        assert np.allclose(values[[0, -1]], [0, 1]) and (np.diff(values) > 0).all()
        assert np.allclose(np.diff(values) * 1000, curve_slope((at[1:] + at[:-1]) / 2, curve), atol=1e-4)


def test_exported_points_are_as_they_were():
    params = {"sh0": torch.rand(4, 1, 3)}
    assert CameraResponse().folded(NUMBERS[None], params) is params


def test_a_photograph_of_another_camera_is_shown_with_its_own_principal_point():
    aside = replace(CAMERA, cx=6.5)
    shown = CameraResponse()(torch.tensor([0.0] * 3 + [1.0] + [0.0] * 7), torch.full((3, 23, 37), 0.5), aside)
    assert shown[0, 11].argmax() == 6 and shown[0, :, 6].argmax() in (10, 11)  # pixel rows on both sides of cy


def test_the_way_back_leads_to_the_scene_but_where_white_was_cut_off(kernels):
    given = 0.1 + 0.85 * colors(5)
    exact = expected(given.double().numpy(), NUMBERS.double().numpy(), CAMERA)
    photo = torch.from_numpy((255 * exact).round() / 255).float()
    found, least = CameraResponse().of_scene(NUMBERS, photo, CAMERA)
    assert 50 < least.sum() < least.numel() / 2
    cut = torch.from_numpy(exact >= 1)
    assert (least[cut] | (found[cut] >= photo[cut])).all() and (found[cut] <= given[cut] + 2e-2).all()
    assert (found - given)[~cut].abs().max() < 0.02 and (found - given)[~cut].abs().mean() < 2e-3


def test_dark_photographs_are_made_as_bright_as_the_scene():
    numbers = torch.tensor([-1.0] * 3 + [0.0] * 8)
    found, least = CameraResponse().of_scene(numbers, torch.full((3, 23, 37), 0.5), CAMERA)
    assert not least.any() and torch.allclose(found, torch.tensor(from_linear(2 * linear(0.5))).float())
    assert CameraResponse().of_scene(numbers, torch.ones(3, 23, 37), CAMERA)[0].max() == 1
