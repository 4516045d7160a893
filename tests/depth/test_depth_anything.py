"""The way weights of Depth Anything V2 are found and used, with a tiny network of the same classes."""

import sys

import numpy as np
import pytest
import torch
from needs import needs
from PIL import Image

from surfkit.core.check import BadInput
from surfkit.depth.base import DepthInput
from surfkit.depth.depth_anything import DepthAnythingV2
from surfkit.scene.camera import Camera
from surfkit.scene.observations import Observations
from surfkit.scene.scene import View
from surfkit.testing import check_depth_estimator

NOTHING = Observations(np.zeros((0, 3)), np.zeros(0), {})


def material(folder) -> DepthInput:
    """One photograph of 120 x 80 pixels."""
    pixels = np.random.default_rng(0).integers(0, 255, (80, 120, 3), np.uint8)
    Image.fromarray(pixels).save(folder / "a.png")
    camera = Camera(torch.eye(4, dtype=torch.float64), 100.0, 100.0, 60.0, 40.0, 120, 80)
    return DepthInput([View("a.png", camera, folder / "a.png")], NOTHING, torch.device("cpu"), folder)


def test_maps_have_the_shape_of_the_photograph_and_weights_come_from_the_folder(weights, tmp_path):
    given, estimator = material(tmp_path), DepthAnythingV2(weights=str(weights), shortest=56)
    (first,), (again,) = (list(estimator.estimate(given, [0])) for _ in range(2))
    assert first.inverse.shape == first.confidence.shape == (56, 84) and torch.equal(first.inverse, again.inverse)
    assert torch.isfinite(first.inverse).all() and (first.inverse >= 0).all() and first.inverse.std() > 0
    assert torch.equal(first.confidence, (first.inverse > 0).float())
    assert not DepthAnythingV2.aligned and not DepthAnythingV2.matched


def test_contract(weights):
    check_depth_estimator(DepthAnythingV2(weights=str(weights), shortest=56))


def test_weights_that_cannot_be_had_are_one_line(tmp_path):
    needs("transformers", "depth-anything-v2")
    with pytest.raises(BadInput, match="cannot be loaded: .*--estimator.weights.*--depth.weights"):
        DepthAnythingV2(weights=str(tmp_path)).network()


def test_without_transformers_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(BadInput, match=r"pip install 'surfkit\[depth\]'"):
        DepthAnythingV2().network()


def test_the_licence_is_shown():
    assert "Apache-2.0" in DepthAnythingV2().notice()
    assert "CC BY-NC 4.0, which forbids commercial use" in DepthAnythingV2(size="large").notice()
    assert DepthAnythingV2(size="large").source == "depth-anything/Depth-Anything-V2-Large-hf"
