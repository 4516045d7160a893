"""What optimizers are told of a step."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch

from surfkit.primitives import Gaussian3D
from surfkit.raster.api import Maps
from surfkit.raster.reference import Reference
from surfkit.train.adam import Adam
from surfkit.train.stage import Stage
from surfkit.train.step import view_gradients


@dataclass(frozen=True)
class Pulling(Adam):
    """One that wants other gradients too."""

    pulls: ClassVar[bool] = True


def test_what_is_pulled_is_the_product_with_the_jacobian(begin):
    """Of the trainer's own step, by differences: a change of the parameters changes the maps."""
    trainer, state = begin(Stage(densify=None, optimizer=Pulling()), Gaussian3D(1))
    result = view_gradients(trainer, state)
    draw = torch.Generator().manual_seed(5)
    cotangent = torch.randn(result.maps.color.shape, generator=draw)
    pulled, camera = result.pull(Maps(color=cotangent)), result.target.view.camera
    assert result.pull(Maps(color=cotangent))["means"].equal(pulled["means"]), "it can be asked again"
    double = {name: value.double() for name, value in state.points.params.items()}
    for name in ("means", "scales", "opacities", "sh0"):
        way = torch.randn(double[name].shape, generator=draw, dtype=torch.float64)
        ends = []
        for sign in (1, -1):
            moved = double | {name: double[name] + sign * 1e-6 * way}
            shown = Reference().render(trainer.primitive.activate(moved, 0), camera, trainer.stage.near).maps.color
            ends.append(float((shown * cotangent).sum()))
        assert float((pulled[name] * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=2e-3), name
