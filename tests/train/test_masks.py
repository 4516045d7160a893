"""What a mask covers teaches nothing and is not measured."""

from dataclasses import replace

import pytest
import torch

from surfkit.core.registry import components
from surfkit.evaluate.images.measure_images import evaluate_views
from surfkit.losses.base import Loss, ignoring
from surfkit.raster.api import Maps
from surfkit.testing import inputs

SIZE = (24, 32)


def covered(seed=0):
    draw = torch.Generator().manual_seed(seed)
    mask = torch.ones(SIZE, dtype=torch.bool)
    mask[5:18, 8:20] = False
    return mask, draw


@pytest.mark.parametrize("name", components(Loss))
def test_no_loss_learns_from_covered_pixels(name):
    mask, draw = covered()
    loss = components(Loss)[name]()
    sample = replace(inputs.target(SIZE, draw), mask=mask)
    given = inputs.maps(torch.rand(SIZE, generator=draw), loss.reads, draw)
    given = replace(given, color=torch.rand(3, *SIZE, generator=draw))
    leaves = {name: value.requires_grad_() for name, value in given.present().items()}
    maps, held = ignoring(Maps(**leaves), sample)
    grads = torch.autograd.grad(loss(maps, held), list(leaves.values()), allow_unused=True)
    there = [grad for grad in grads if grad is not None]
    assert there and all((grad[..., ~mask] == 0).all() for grad in there)
    assert any((grad[..., mask] != 0).any() for grad in there)


@pytest.mark.parametrize("name", ["l1", "ssim"])
def test_what_is_under_a_mask_makes_no_difference(name):
    mask, draw = covered()
    loss, sample = components(Loss)[name](), replace(inputs.target(SIZE, draw), mask=mask)
    color = torch.rand(3, *SIZE, generator=draw)
    other = replace(sample, photo=torch.where(mask, sample.photo, torch.rand(3, *SIZE, generator=draw)))
    values = [loss(*ignoring(Maps(color=color), given)) for given in (sample, other)]
    assert values[0] == values[1]
    right = replace(sample, photo=torch.where(mask, color, sample.photo))
    assert loss(*ignoring(Maps(color=color), right)) < 1e-6, "all that counts is right"


@pytest.mark.parametrize("terms", [None, ("ssim",)])
def test_training_with_a_mask_does_not_depend_on_what_it_covers(tiny, begin, terms):
    from surfkit.densify.signal import LossGradient
    from surfkit.train.stage import Stage

    mask = torch.ones(22, 28, dtype=torch.bool)
    mask[4:14, 6:20] = False
    results = []
    for value in (0, 255):
        photos = [torch.where(mask, photo, torch.tensor(value, dtype=torch.uint8)) for photo in tiny.photos]
        trainer, state = begin(Stage(steps=12, densify=None, signal=LossGradient(terms=terms)))
        trainer = replace(trainer, photos=photos, masks=[mask] * len(photos))
        for _ in trainer.run(state):
            pass
        results.append(state.points.params)
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


def test_covered_pixels_are_not_measured(tiny):
    mask, _ = covered()
    mask = torch.ones(22, 28, dtype=torch.bool)
    mask[4:14, 6:20] = False
    views = tiny.views[:3]
    maps = {view.name: tiny.rasterizer.render(tiny.truth, view.camera, 0.005).maps for view in views}
    wrong = [torch.where(mask, photo, 255 - photo) for photo in tiny.photos]
    masks = [mask, None, torch.zeros_like(mask)]
    found = evaluate_views(views, wrong, lambda view: maps[view.name], masks=masks)["images"]
    first, second = found["per_image"][views[0].name], found["per_image"][views[1].name]
    assert first["psnr"] > 50 and first["ssim"] > 0.999 and first["psnr_aligned"] > 50 and first["ssim_aligned"] > 0.999
    assert second["psnr"] < 30 and views[2].name not in found["per_image"]


def test_the_coming_order_is_told(tiny, begin):
    from surfkit.train.stage import Stage

    told, asked = [], []

    class Watched(list):
        def __getitem__(self, at):
            asked.append(at)
            return super().__getitem__(at)

    trainer, state = begin(Stage(steps=15, densify=None))
    trainer = replace(trainer, photos=Watched(tiny.photos), expect=told.append)
    for _ in trainer.run(state):
        pass
    assert [at for order in told for at in order][:15] == asked and len(told) == 3
    told.clear()
    trainer = replace(trainer, stage=replace(trainer.stage, steps=16))
    for _ in trainer.run(state):
        pass
    assert told[0][0] == asked[-1] and len(told[0]) == 3
