"""What policies are told of the pixels of a step, against sums over pixels in float64."""

from dataclasses import dataclass, field, replace

import pytest
import torch

from surfkit.core.schedule import LearningRate
from surfkit.densify import ADC, PointCap
from surfkit.densify.base import Prune
from surfkit.primitives import Gaussian3D, Surfel2D
from surfkit.primitives.init import SH_C0
from surfkit.raster.reference import draw
from surfkit.train.adam import Adam, AdamInView
from surfkit.train.stage import Stage


@dataclass(frozen=True)
class Looking(Prune):
    """Keeps what it is told of the pixels, of which points, and what these were drawn as."""

    seen: list = field(default_factory=list)

    def watch(self, points, step):
        """Look at the view while it is there."""
        rows = torch.arange(len(points)) if step.shown.rows is None else step.shown.rows
        self.seen.append((step.view, rows, step.splats))

    def edit(self, points, step):
        """Change nothing."""


def weights(splats, camera, near):
    """(N, H, W) float64 weight of each splat in each pixel: it alone is white, and all others are black."""
    black = torch.full((len(splats), 1, 3), -0.5 / SH_C0, dtype=torch.float64)
    found = []
    for k in range(len(splats)):
        sh = black.clone()
        sh[k] = 0.5 / SH_C0
        with torch.no_grad():
            found.append(draw(splats.with_colors(sh), camera, near).maps.color[0])
    return torch.stack(found)


@pytest.mark.parametrize("optimizer", [Adam(), AdamInView()], ids=["adam", "in-view"])
@pytest.mark.parametrize("primitive", [Surfel2D(1), Gaussian3D(1)], ids=["surfel", "gaussian"])
@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
def test_values_of_pixels_go_back_in_the_share_of_the_weights(begin, optimizer, primitive, masked):
    looking = Looking()
    still = {name: LearningRate(0.0) for name in primitive.columns()}  # so that the splats stay what they were
    stage = Stage(steps=2, densify=None, prune=(looking,), optimizer=optimizer, rates=still)
    trainer, state = begin(stage, primitive)
    state.points.params["sh0"][::3] = -4.0  # their colour is held at 0, where no gradient goes through
    mask = torch.ones(22, 28, dtype=torch.bool)
    if masked:
        mask[4:14, 6:20] = False
        trainer = replace(trainer, masks=[mask] * len(trainer.views))
    done = trainer.step(state)
    ((view, rows, splats),), camera, near = looking.seen, done.target.view.camera, trainer.stage.near
    double = splats.with_named({name: value.double() for name, value in splats.named().items()})
    values = torch.rand(22, 28, generator=torch.Generator().manual_seed(1))
    values *= ~draw(double, camera, near).near_threshold  # where rounding decides whether a splat counts
    wanted = (weights(double, camera, near) * values * mask).sum((1, 2)).float()
    assert wanted[::3].max() > 0.5 and wanted.max() > 5
    told = torch.zeros(len(splats)).index_copy(0, rows, view.blended(values))
    assert torch.allclose(told, wanted, rtol=1e-4, atol=1e-4)
    assert view.color.shape == view.photo.shape == (3, 22, 28)
    same = (view.color == view.photo).all(0)
    assert same[~mask].all() and not same[mask].all()


def test_a_limit_needs_what_the_densifier_within_needs(monkeypatch):
    assert not PointCap().needs_pixels
    monkeypatch.setattr(ADC, "needs_pixels", property(lambda _: True))
    assert PointCap().needs_pixels
