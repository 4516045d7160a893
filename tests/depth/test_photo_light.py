"""Photographs of two cameras in changing light are alike afterwards."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.depth.base import DepthInput
from surfkit.depth.photo_light import EvenLight
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import observations, read
from surfkit.scene.photos import read_photo
from surfkit.scene.srgb import from_linear, linear
from surfkit.testing.synthetic import Flight, photograph, write_colmap

CPU = torch.device("cpu")
EXPONENTS = {"A": 0.85, "B": 1.2}


def pixels(view) -> torch.Tensor:
    """(3, H, W) in [0, 1]."""
    camera = view.camera
    return read_photo(view.path, (camera.width, camera.height)).double() / 255


@pytest.fixture(scope="module")
def changed(tmp_path_factory):
    """The views of a flight with exposures, white balance, dark corners and response curves; and as they were."""
    plain = tmp_path_factory.mktemp("plain")
    flight = Flight(kind="grid", views=20, width=120, height=90, points=600, test_every=0)
    write_colmap(plain, photograph(flight), tracks=True)
    data = Data(plain, test_every=0)
    scene = read(data)
    tracks = observations(data, scene)
    folder, draw = tmp_path_factory.mktemp("changed"), np.random.default_rng(2)
    views, before = [], []
    for at, view in enumerate(scene.train):
        color = pixels(view).numpy().transpose(1, 2, 0)
        height, width = color.shape[:2]
        y, x = np.mgrid[:height, :width] + 0.5
        r2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width**2 + height**2) * 4
        stops = draw.uniform(-1.2, -0.2) + np.log2(draw.uniform(0.9, 1.1, 3))
        light = linear(color) * 2**stops * (1 - 0.4 * r2)[..., None]
        camera = "AB"[at % 2]
        made = (255 * from_linear(light) ** EXPONENTS[camera]).round().astype(np.uint8)
        path = folder / f"{at}.png"
        Image.fromarray(made).save(path)
        views.append(replace(view, path=path, taken_by=camera))
        before.append(color.transpose(2, 0, 1))
    return views, before, tracks


def apart(found, truth) -> float:
    """Standard deviation of what is left between colours (V, 3, H, W) and the truth, as logarithms of light, but for
    one factor of each channel and one exponent that all photographs share: these nobody can know."""
    a, b = (np.log(linear(np.stack(each)[:, :, ::3, ::3]).clip(1e-3)) for each in (found, truth))
    usable = (np.stack(truth)[:, :, ::3, ::3] > 0.15) & (np.stack(found)[:, :, ::3, ::3] > 0.1)
    left = []
    for channel in range(3):
        x, y = (each[:, channel][usable[:, channel]] for each in (b, a))
        left.append(y - np.polyval(np.polyfit(x, y, 2), x))
    return float(np.concatenate(left).std())


def test_photographs_are_alike_but_for_one_curve(changed, tmp_path):
    views, before, tracks = changed
    light = EvenLight(DepthInput(views, tracks, CPU, tmp_path))
    after = [light.even(pixels(view), at, view.camera).numpy() for at, view in enumerate(views)]
    assert apart([pixels(view).numpy() for view in views], before) > 0.3
    assert apart(after, before) < 0.06


def test_the_mean_brightness_stays(changed, tmp_path):
    views, _, tracks = changed
    light = EvenLight(DepthInput(views, tracks, CPU, tmp_path))
    given, made = (
        np.log(linear(np.stack(each)).clip(1e-3)).mean()
        for each in (
            [pixels(view).numpy() for view in views],
            [light.even(pixels(view), at, view.camera).numpy() for at, view in enumerate(views)],
        )
    )
    assert abs(given - made) < 0.1


def test_grey_values_of_a_grey_photograph_are_those_of_its_colours(changed, tmp_path):
    views, _, tracks = changed
    light = EvenLight(DepthInput(views, tracks, CPU, tmp_path))
    light.stops[:] = light.stops.mean(1, keepdims=True)  # no white balance
    grey = pixels(views[3]).mean(0)
    colored = light.even(grey.expand(3, -1, -1), 3, views[3].camera)
    torch.testing.assert_close(light.even(grey, 3, views[3].camera), colored[1], rtol=0, atol=1e-12)


def test_nothing_changes_where_nothing_tells(changed, tmp_path):
    views, _, tracks = changed
    shown = pixels(views[0])
    assert (
        EvenLight(DepthInput(views, tracks, CPU, tmp_path, in_one_light=True)).even(shown, 0, views[0].camera) is shown
    )
    few = replace(tracks, seen={name: one for name, one in tracks.seen.items() if name != views[0].name})
    light = EvenLight(DepthInput(views, few, CPU, tmp_path))
    assert not light.stops[0].any() and light.stops[1].any()
