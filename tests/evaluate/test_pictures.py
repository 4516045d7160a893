"""Pictures: the colours mean what they say, and the files are where they should be."""

import numpy as np
import pytest
import torch
from PIL import Image

from surfkit.evaluate.images.comparison_pictures import (
    RAMP,
    colour_depth,
    colour_normal,
    panel,
    picture_path,
    write_picture,
)
from surfkit.raster.api import Maps


def test_near_is_pale_and_nothing_is_black():
    depth = torch.linspace(1, 2, 50).reshape(5, 10)
    depth[0, :2] = torch.tensor([0, float("nan")])
    image = colour_depth(depth)
    assert image.shape == (3, 5, 10) and 0 <= image.min() and image.max() <= 1
    assert not image[:, 0, :2].any() and image[:, 0, 2:].any(0).all()
    light = image.mean(0).flatten()[2:]
    assert (light.diff() <= 1e-6).all() and light[0] - light[-1] > 0.5
    torch.testing.assert_close(image[:, -1, -1], torch.tensor(RAMP[0]).float())


def test_a_few_far_pixels_do_not_take_the_range():
    depth = torch.linspace(1, 2, 1000).reshape(20, 50)
    spoilt = depth.clone()
    spoilt[0, 0] = 1e6
    assert (colour_depth(spoilt) - colour_depth(depth))[:, 1:].abs().max() < 0.02
    assert not colour_depth(torch.zeros(3, 4)).any()
    assert colour_depth(torch.full((3, 4), 7.0)).isfinite().all()


def test_lightness_of_the_ramp_is_even():
    """CIE L*, a measure other than the one the ramp was made with."""
    linear = np.where(RAMP <= 0.04045, RAMP / 12.92, ((RAMP + 0.055) / 1.055) ** 2.4)
    luminance = linear @ [0.2126, 0.7152, 0.0722]
    lightness = 116 * np.cbrt(luminance) - 16
    steps = np.diff(lightness)
    assert (steps > 6).all() and steps.max() / steps.min() < 2


def test_normals_towards_the_camera_are_blue():
    facing, up, right = (0.0, 0.0, -1.0), (0.0, -0.5, 0.0), (2.0, 0.0, 0.0)
    image = colour_normal(torch.tensor([facing, up, right, (0.0, 0.0, 0.0)]).T.reshape(3, 1, 4))[:, 0].T
    expected = [[0.5, 0.5, 1], [0.5, 1, 0.5], [1, 0.5, 0.5], [0, 0, 0]]
    torch.testing.assert_close(image, torch.tensor(expected))


def test_a_panel_has_what_the_maps_have():
    photo = torch.full((3, 4, 6), 51, dtype=torch.uint8)
    color, alpha, plane = torch.full((3, 4, 6), 1.5), torch.ones(4, 6), torch.ones(4, 6)
    assert panel(photo, Maps(color=color, alpha=alpha)).shape == (3, 4, 12)
    full = panel(photo, Maps(color=color, alpha=alpha, depth=plane, median=0 * plane, normal=-color))
    assert full.shape == (3, 4, 24)
    assert (full[:, :, :6] == 0.2).all() and (full[:, :, 6:12] == 1).all()
    assert not full[:, :, 12:18].any()  # the median depth, which is there, wins
    assert panel(photo, Maps(color=color, alpha=alpha, depth=plane))[:, :, 12:].any()


def test_png_is_rounded_and_whole(tmp_path):
    image = torch.tensor([0.0, 0.9999, 1.5, 127.4 / 255, 127.6 / 255, -1]).repeat(3, 1, 1)
    path = tmp_path / "deep" / "a.png"
    write_picture(path, image)
    assert np.asarray(Image.open(path))[0, :, 0].tolist() == [0, 255, 255, 127, 128, 0]
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("a.jpg", "a.jpg.png"),
        ("left/a.jpg", "left/a.jpg.png"),
        ("left\\a.jpg", "left/a.jpg.png"),
        ("left/a:1.jpg", "left/a_1.jpg.png"),
    ],
)
def test_pictures_are_called_as_their_photographs(tmp_path, name, file):
    assert picture_path(tmp_path, name) == tmp_path / file


def test_names_that_lead_elsewhere_stay_below_the_folder_and_apart(tmp_path):
    names = ["a.jpg", "../a.jpg", "../../a.jpg", "/a.jpg", "..\\a.jpg", "b/../a.jpg"]
    paths = [picture_path(tmp_path, name) for name in names]
    assert len(set(paths)) == len(names)
    assert all(path.resolve().is_relative_to(tmp_path.resolve()) for path in paths)
