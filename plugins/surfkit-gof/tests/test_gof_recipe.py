"""The recipe: its parts at their published values, its row in the table of methods, and a short training."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import surfkit_gof
import torch
from surfkit_gof import GOF, PAPER
from surfkit_gof.mesher import OpacityField

from surfkit.core.registry import plugins
from surfkit.core.schedule import LearningRate
from surfkit.densify import MatchedADC
from surfkit.plugin import Mesher, components, rescale
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints, View
from surfkit.study.ablation import build, offered_tables
from surfkit.train.trainer import Trainer


@pytest.fixture(autouse=True)
def offered():
    """The plugin, as if it were installed, where it is not."""
    there = OpacityField in components(Mesher).values()
    if not there:
        plugins().register(surfkit_gof, "gof of this test")
    yield
    if not there:
        plugins().unregister(surfkit_gof)


def test_the_recipe_is_that_of_the_paper():
    stage = GOF.pretrain
    assert not any(loss in stage.weights_at(15_000) for loss in ("normal", "distortion"))
    assert stage.weights_at(15_001)["normal"] == 0.05 and stage.weights_at(15_001)["distortion"] == 100
    assert stage.densify.adc.threshold == 2e-4 and stage.densify.adc.cull_opacity == 0.05
    short = rescale(stage, 0.1)
    assert short.losses["normal"].start == 1_500 and short.densify.adc.until == 1_500
    GOF.refuse_unfit()


def test_its_row_stands_in_the_table_of_methods():
    table = offered_tables()["methods"]
    row = next(row for row in table.rows if row.label == "GOF")
    assert row.paper == PAPER and build(table)["GOF"].pretrain == GOF.pretrain


def test_a_short_training_with_the_recipe():
    draw, rasterizer, views = torch.Generator().manual_seed(3), select("cpu")[0], []
    for x in (-0.1, 0.1):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3], pose[2, 3] = -x, 1.0
        views.append(View(f"{x}.png", Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24), Path(f"{x}.png")))
    y, x = torch.meshgrid(torch.arange(24), torch.arange(32), indexing="ij")
    photo = (127 + 120 * torch.stack([torch.sin(x / 3), torch.sin(y / 4), torch.cos((x + y) / 5)])).to(torch.uint8)
    cloud = SparsePoints(0.6 * (torch.rand(80, 3, generator=draw) - 0.5), torch.full((80, 3), 127, dtype=torch.uint8))
    stage = rescale(GOF.pretrain, 160 / 30_000)
    densify = MatchedADC(replace(stage.densify.adc, start=10, until=120, every=20, reset_every=1_000))
    rates = {"means": LearningRate(1.6e-4)}
    trainer = Trainer(replace(stage, densify=densify, rates=rates), GOF.primitive, views, [photo, photo], rasterizer)
    state = trainer.begin(Points.fresh(GOF.primitive.init(cloud, draw)), draw)
    done = list(trainer.run(state))
    first, last = (sum(d.losses["l1"] for d in part) for part in (done[:20], done[-20:]))
    assert last < 0.8 * first and max(d.points for d in done) > 80
    assert math.isfinite(last) and done[-1].losses.keys() == {"l1", "ssim", "normal", "distortion"}
