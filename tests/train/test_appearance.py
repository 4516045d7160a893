from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from surfkit.appearance import CameraResponse, Exposure
from surfkit.appearance.base import Appearance, PhotoLight
from surfkit.densify import LossGradient
from surfkit.losses.base import Target
from surfkit.losses.photometric import L1, SSIM
from surfkit.raster.api import Maps
from surfkit.scene.srgb import from_linear, linear
from surfkit.train.checkpoint import load, save
from surfkit.train.image_appearance import ImageAppearance, first_appearances, in_light
from surfkit.train.loss_gradients import loss_gradients
from surfkit.train.stage import Stage

GAINS = torch.tensor([1.0, 0.5, 1.0, 0.5, 1.0, 0.5])


@dataclass(frozen=True)
class Tint(Appearance):
    """A gain of each photograph, one of all for each channel, and structure is compared without them."""

    spares_structure: ClassVar[bool] = True

    def begin(self, count):
        return torch.zeros(count, 1)

    def begin_shared(self):
        return torch.zeros(3)

    def rate_at(self, index, steps):
        return 1e-2

    def __call__(self, numbers, color, camera):
        return color * (numbers[0] + numbers[1:]).exp()[:, None, None]

    def folded(self, numbers, params):
        return params


def trained(begin, stage, path=None):
    """Losses of the last 60 steps, of photographs of which every second one is dark."""
    trainer, state = begin(stage)
    photos = [(photo * gain).byte() for photo, gain in zip(trainer.photos, GAINS, strict=True)]
    trainer, losses = replace(trainer, photos=photos), []
    for done in trainer.run(state):
        losses.append(done.losses["l1"])
        if done.index == 100 and path is not None:
            save(path, state)
    return sum(losses[-60:]), state, trainer


def test_each_photograph_learns_its_own_exposure(begin, tmp_path):
    stage = Stage(steps=240, densify=None, sh_every=1_000)
    plain = trained(begin, stage)[0]
    exposed = replace(stage, appearance=Exposure(5e-2, 5e-3))
    learned, state, trainer = trained(begin, exposed, tmp_path / "c.safetensors")
    assert learned < 0.65 * plain
    value = state.appearances["value"]
    grey = torch.tensor([0.4, 0.4, 0.4, 1.0])
    bright, dark = ((value[GAINS == gain] @ grey).mean() for gain in (1.0, 0.5))
    assert 0.35 < dark / bright < 0.65
    assert state.appearances.keys() == {"value", "first", "second", "shown"}
    assert state.appearances["shown"].tolist() == [40] * 6
    again = load(tmp_path / "c.safetensors")
    list(trainer.run(again))
    assert torch.equal(again.appearances["value"], value)
    assert torch.equal(again.points.params["sh0"], state.points.params["sh0"])


def test_who_watches_gets_the_render_as_the_photograph_shows_it(begin):
    """Training PSNR is of it: in the colours of the scene it would fall while the model gets better."""
    trainer, state = begin(Stage(steps=40, densify=None, sh_every=1_000, appearance=Exposure(5e-2, 5e-3)))
    done = list(trainer.run(state))[-1]
    assert (done.shown() - done.maps.need("color")).abs().max() > 0.01 and not done.shown().requires_grad
    plain, state = begin(Stage(steps=1, densify=None, sh_every=1_000))
    done = next(plain.run(state))
    assert done.shown() is done.maps.need("color")


def test_shared_numbers_are_learned_in_every_step_and_saved(begin, tmp_path):
    stage = Stage(steps=160, densify=None, sh_every=1_000, appearance=Tint())
    _, state, trainer = trained(begin, stage, tmp_path / "c.safetensors")
    assert state.appearances["shared"].abs().max() > 0.05, "further than the 27 steps of one photograph would go"
    again = load(tmp_path / "c.safetensors")
    list(trainer.run(again))
    assert again.appearances.keys() == state.appearances.keys()
    for name, value in state.appearances.items():
        assert torch.equal(again.appearances[name], value), name


def test_adam_counts_the_steps_of_all_photographs_for_what_they_share(begin):
    """A gradient that is always the same moves by the rate at each step, if moments are corrected by their steps."""
    table, camera = first_appearances(Tint(), 2, None), begin(Stage())[0].views[0].camera
    for at in (0, 1, 1, 0, 1):
        step = ImageAppearance(Tint(), table, at, 0.1, camera)
        step.add([torch.ones(1), None])
        step.add([None, torch.ones(3)])
        step.learn()
    assert table["shown"].tolist() == [2, 3]
    assert torch.allclose(table["value"], torch.tensor([[-0.2], [-0.3]]))
    assert torch.allclose(table["shared"], torch.full((3,), -0.5))


def scene(seed=0):
    """Colours, a target with a mask and, of Tint, numbers of one photograph and shared ones, in float64."""
    draw = torch.Generator().manual_seed(seed)
    color, photo = (torch.rand(3, 13, 14, generator=draw, dtype=torch.float64) for _ in range(2))
    mask = torch.rand(13, 14, generator=draw) > 0.3
    numbers = 0.3 * torch.randn(4, generator=draw, dtype=torch.float64)
    return color, photo, mask, numbers


@pytest.mark.parametrize("terms", [None, ("ssim",), ("l1",)])
@pytest.mark.parametrize("masked", [False, True])
def test_structure_is_compared_without_the_change_and_gradients_are_those_of_differences(begin, terms, masked):
    color, photo, mask, numbers = scene()
    view = begin(Stage())[0].views[0]
    losses, weights, keep = {"l1": L1(), "ssim": SSIM()}, {"l1": 0.8, "ssim": 0.2}, mask if masked else None
    target = Target(view, photo, mask=keep)
    table = first_appearances(Tint(), 1, None) | {"value": numbers[None, :1], "shared": numbers[1:]}
    appearance = ImageAppearance(Tint(), table, 0, 1.0, view.camera)
    given = losses, LossGradient(terms=terms), weights, Maps(color=color), target, appearance
    found, total, chosen = loss_gradients(*given)

    def values(color, numbers):
        """By hand: hidden pixels of the photograph are those of what it is compared with, which stay as they were."""
        shown = Tint()(numbers, color, view.camera)
        plain = photo if keep is None else torch.where(keep, photo, start)
        color = color if keep is None else torch.where(keep, color, start)
        apart = (shown - photo).abs() if keep is None else torch.where(keep, (shown - photo).abs(), 0)
        return {"l1": 0.8 * apart.mean(), "ssim": 0.2 * SSIM()(Maps(color=color), Target(view, plain))}

    start = color
    for name, value in values(color, numbers).items():
        assert found[name] == pytest.approx(float(value), rel=1e-12), name
    draw, step = torch.Generator().manual_seed(1), 1e-6
    for names, gradient in (("l1 ssim", total), (" ".join(terms or ()), chosen)):
        if not names or gradient is None:
            assert terms is None
            continue
        way = torch.randn(color.shape, generator=draw, dtype=torch.float64)
        up, down = (values(color + sign * step * way, numbers) for sign in (1, -1))
        slope = sum(float(up[name] - down[name]) for name in names.split()) / (2 * step)
        assert float((gradient.color * way).sum()) == pytest.approx(slope, rel=1e-5)
    own, shared = appearance.grads
    for at, gradient in enumerate(torch.cat([own, shared])):
        way = step * torch.eye(4, dtype=torch.float64)[at]
        up, down = (float(values(color, numbers + sign * way)["l1"]) for sign in (1, -1))
        assert float(gradient) == pytest.approx((up - down) / (2 * step), rel=1e-5), "of L1 alone"


def test_where_only_structure_counts_nothing_is_learned_of_photographs(begin):
    stage = Stage(steps=6, densify=None, losses={"ssim": SSIM()}, appearance=Tint())
    _, state = begin(stage)
    list(begin(stage)[0].run(state))
    assert not any(value.any() for value in state.appearances.values())


def test_colours_are_compared_in_the_light_of_the_scene_where_the_way_back_is_known(begin):
    """A photograph of half the exposure counts as one of the mean; where white is cut off, nothing is darkened."""
    trainer, state = begin(Stage(steps=10, densify=None, appearance=CameraResponse(), losses={"l1": L1(1.0)}))
    stops = torch.zeros(len(trainer.views), 3)
    stops[1], stops[2] = -1.0, 1.0
    light = PhotoLight(stops, torch.zeros(len(trainer.views), 8))
    state.appearances = first_appearances(CameraResponse(), len(trainer.views), light)
    view, color = trainer.views[0], torch.full((3, *trainer.photos[0].shape[1:]), 0.7)
    color[:, :4] = 0.9

    def compared(row, photo):
        target, appearance = in_light(trainer.stage, state, row, Target(view, photo), color)
        assert appearance is None
        return target.photo

    half = torch.full_like(color, 0.5)
    assert torch.allclose(compared(0, half), half, atol=1e-6)
    brighter = torch.tensor(from_linear(2 * linear(0.5))).float()
    assert torch.allclose(compared(1, half), brighter.expand_as(half), atol=1e-6)
    white = float(from_linear(np.array(0.5)))
    found = compared(2, torch.ones_like(color))
    assert torch.equal(found[:, :4], color[:, :4]) and 0.7 < white < 0.9
    assert torch.allclose(found[:, 4:], torch.tensor(white).float().expand_as(found[:, 4:]), atol=1e-6)
    learned = ImageAppearance(CameraResponse(), state.appearances, 0, 0.1, view.camera)
    assert learned.of_scene(half) is None
    learning = replace(trainer.stage, appearance=Exposure(5e-2, 5e-3))
    state.appearances = first_appearances(learning.appearance, len(trainer.views), None)
    target, appearance = in_light(learning, state, 1, Target(view, half), color)
    assert appearance is not None and target.photo is half
