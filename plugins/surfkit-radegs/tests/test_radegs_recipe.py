"""The recipe: its parts at their published values, its row in the table of methods, and a short training."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import surfkit_radegs
import torch
from surfkit_radegs import RADEGS

from surfkit.core.registry import offered, plugins
from surfkit.core.schedule import LearningRate
from surfkit.losses.base import Target
from surfkit.plugin import rescale
from surfkit.primitives.points import Points
from surfkit.raster.api import Maps
from surfkit.raster.normals import disagreement_reference
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints, View
from surfkit.study.ablation import build, offered_tables
from surfkit.train.trainer import Trainer


@pytest.fixture(autouse=True)
def registered():
    """The plugin, as if it were installed, where it is not."""
    there = any(name == "radegs" for _, name, _ in offered("surfkit_recipes"))
    if not there:
        plugins().register(surfkit_radegs, "radegs of this test")
    yield
    if not there:
        plugins().unregister(surfkit_radegs)


def seen_from(x: float) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3], pose[2, 3] = -x, 1.0
    return View(f"{x}.png", Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24), Path(f"{x}.png"))


def test_the_recipe_is_that_of_the_paper():
    stage = RADEGS.pretrain
    names = {"normal", "normal-median"}
    assert not names & stage.weights_at(15_000).keys()
    weights = stage.weights_at(15_001)
    assert weights["normal"] == pytest.approx(0.02) and weights["normal-median"] == pytest.approx(0.03)
    assert (
        RADEGS.primitive.geometry == "plane"
        and stage.densify.adc.cull_opacity == 0.05
        and RADEGS.primitive.smoothing == 0.2
    )
    assert rescale(stage, 0.1).losses["normal-median"].start == 1_500
    RADEGS.refuse_unfit()


def test_the_normal_terms_are_the_mean_of_both_depths_as_published():
    """0.05 (0.4 of the expected depth + 0.6 of the median depth), each against the normals of that depth."""
    draw, view = torch.Generator().manual_seed(1), seen_from(0.0)
    alpha, median = (0.5 + 0.5 * torch.rand(24, 32, generator=draw) for _ in range(2))
    depth, normal = (1 + 0.1 * torch.rand(24, 32, generator=draw)) * alpha, torch.randn(3, 24, 32, generator=draw)
    maps = Maps(color=normal, alpha=alpha, depth=depth, median=median, normal=normal)
    losses, weights = RADEGS.pretrain.losses, RADEGS.pretrain.weights_at(20_000)
    target = Target(view, normal)
    made = sum(weights[name] * losses[name](maps, target) for name in ("normal", "normal-median"))
    double = [value.double() for value in (depth / alpha, median, alpha, normal)]
    expected, middle = (disagreement_reference(d, double[2], double[3], view.camera) for d in double[:2])
    assert made.item() == pytest.approx(0.05 * (0.4 * expected + 0.6 * middle).item(), rel=1e-5)


def test_its_row_stands_in_the_table_of_methods():
    assert build(offered_tables()["methods"])["RaDe-GS"].pretrain == RADEGS.pretrain


def test_a_short_training_with_the_recipe():
    draw, rasterizer = torch.Generator().manual_seed(3), select("cpu")[0]
    views = [seen_from(x) for x in (-0.1, 0.1)]
    y, x = torch.meshgrid(torch.arange(24), torch.arange(32), indexing="ij")
    photo = (127 + 120 * torch.stack([torch.sin(x / 3), torch.sin(y / 4), torch.cos((x + y) / 5)])).to(torch.uint8)
    cloud = SparsePoints(0.6 * (torch.rand(80, 3, generator=draw) - 0.5), torch.full((80, 3), 127, dtype=torch.uint8))
    stage = rescale(RADEGS.pretrain, 160 / 30_000)
    adc = replace(stage.densify.adc, start=10, until=120, every=20, reset_every=1_000)
    densify = replace(stage.densify, adc=adc)
    rates = {"means": LearningRate(1.6e-4)}
    trainer = Trainer(replace(stage, densify=densify, rates=rates), RADEGS.primitive, views, [photo, photo], rasterizer)
    done = list(trainer.run(trainer.begin(Points.fresh(RADEGS.primitive.init(cloud, draw)), draw)))
    first, last = (sum(d.losses["l1"] for d in part) for part in (done[:20], done[-20:]))
    assert last < 0.8 * first and max(d.points for d in done) > 80
    assert math.isfinite(last) and done[-1].losses.keys() == {"l1", "ssim", "normal", "normal-median"}
