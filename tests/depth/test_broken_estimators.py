"""Estimators of a plugin that give maps of other shapes, or of other views, are named in one line: a photograph would
be given the depth of another, and damaged maps be made again in each run."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch
from models import data_set

import surfkit
from surfkit.plugin import BadInput, DepthEstimator, DepthRegression, Estimate

SIZE = (18, 24)


@dataclass(frozen=True)
class Broken(DepthEstimator):
    """Gives something else than the depth of a view."""

    aligned: ClassVar[bool] = True

    how: str = "tuple"

    def estimate(self, given, wanted):
        half, sure = torch.full(SIZE, 0.5), torch.ones(SIZE)
        for at in wanted:
            yield {
                "tuple": (at, half, sure),
                "last": Estimate(-1, half, sure),
                "beyond": Estimate(at + 100, half, sure),
                "thick": Estimate(at, half[None], sure),
                "small": Estimate(at, half, sure[::2]),
                "wide": Estimate(at, half.double(), sure),
                "numpy": Estimate(at, np.ones(SIZE, np.float32), sure),
                "turned": Estimate(at, half, sure, torch.ones(*SIZE, 3)),
                "behind": Estimate(at, -half, sure),
            }[self.how]


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("tuple", "expected Estimate, got tuple"),
        ("last", "at is -1, no position of a view that was asked for"),
        ("beyond", r"at is 10\d, no position"),
        ("thick", r"inverse: expected shape \(h, w\), got \(1, 18, 24\)"),
        ("small", r"confidence: expected shape \(h, w\) with h = 18, w = 24, got \(9, 24\)"),
        ("wide", "inverse: expected a tensor of float32 .*, got a tensor of float64"),
        ("numpy", "inverse: expected a tensor of float32 .*, got ndarray"),
        ("turned", r"normal: expected shape \(3, h, w\) with h = 18, w = 24, got \(18, 24, 3\)"),
        ("behind", "inverse is below 0; give that of camera z"),
    ],
)
def test_the_estimator_is_named(tmp_path, how, said):
    surfkit.offer("broken-depth", Broken)
    recipe = surfkit.evolve(surfkit.get_recipe("2dgs"), "depth", Broken(how))
    recipe = surfkit.evolve(recipe, "pretrain.losses.depth", DepthRegression())
    with pytest.raises(BadInput, match=f"Broken.estimate: {said}") as error:
        surfkit.train(recipe, data_set(tmp_path / "scene"), tmp_path / "run", steps=2)
    assert "\n" not in str(error.value)
