"""Evaluation, LPIPS, assigning views and contribution passes on a simulated GPU: done there, with few waits."""

import shutil
from dataclasses import replace

import pytest
import torch

from surfkit.evaluate.images.comparison_pictures import panel
from surfkit.evaluate.images.lpips import Perceptual
from surfkit.evaluate.images.measure_images import evaluate_views
from surfkit.partition import PictureShare, SSIMDifference
from surfkit.primitives import Surfel2D
from surfkit.primitives.model import SplatModel
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.run_method import with_drawing
from surfkit.testing.inputs import coarse_model
from surfkit.testing.simulated_gpu import GPU, OnSimulatedGpu, is_there, simulated_gpu
from surfkit.train.view_order import ViewContributions

pytestmark = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "c++", "clang++")), reason="the emulator needs a C++ compiler"
)


def network(device):
    """AlexNet with few channels and random weights."""
    draw = torch.Generator().manual_seed(0)
    channels, sizes = (3, 4, 5, 6, 5, 4), (11, 5, 3, 3, 3)
    shapes = [(channels[i + 1], channels[i], size, size) for i, size in enumerate(sizes)]
    kernels, biases, heads = (
        tuple(torch.rand(shape, generator=draw).to(device) - (0.5 if len(shape) == 4 else 0) for shape in of)
        for of in (shapes, [shape[:1] for shape in shapes], [shape[:1] for shape in shapes])
    )
    return Perceptual("alex", kernels, biases, heads)


@pytest.fixture(scope="module")
def sight():
    found = coarse_model(600)
    views = [replace(view, camera=view.camera.resized(72, 60)) for view in found.views[::4]]  # halves fit LPIPS
    return replace(found, views=views)


@pytest.fixture(scope="module")
def made(sight):
    primitive, discs = Surfel2D(sh_degree=0), sight.splats
    params = {
        "means": discs.means,
        "quats": discs.quats,
        "scales": discs.scales.log(),
        "opacities": discs.opacities.logit(),
        "sh0": discs.sh0,
        "sh_rest": discs.sh_rest,
    }
    assert params.keys() == primitive.columns().keys()
    return Reconstruction(splats=SplatModel(primitive, params, 0, sight.near))


def measured(sight, made, rasterizer, device, show=None):
    """The metrics of what is drawn, against photographs that are a little brighter, with masks."""
    drawn = with_drawing(made, rasterizer)
    truth = with_drawing(made, sight.rasterizer)
    photos = [((truth.draw(view).color + 0.05).clamp(0, 1) * 255).to(torch.uint8) for view in sight.views]
    masks = [None, torch.arange(72).expand(60, 72) > 9, *[None] * len(sight.views[2:])]
    found = evaluate_views(
        sight.views, photos, drawn.draw_there, timed=drawn.draw_color, show=show, masks=masks,
        networks=[network(device)],
    )  # fmt: skip
    assert found["fps"] > 0
    return found["images"]


def test_photographs_are_measured_where_they_are_drawn(sight, made):
    here = measured(sight, made, sight.rasterizer, "cpu")
    shown = []
    with simulated_gpu() as gpu:
        there = measured(sight, made, OnSimulatedGpu(sight.rasterizer), GPU, lambda *given: shown.append(given))
        assert all(is_there(maps.color) and not is_there(panel(photo, maps)) for _, photo, maps in shown)
        waits = {name: count for name, count in gpu.waits.items() if name not in ("to cpu", "synchronize")}
    views = len(sight.views)
    assert sum(waits.values()) <= 12 * views, f"{waits}: one for each number of a view, and for a mask"
    assert {"psnr", "ssim", "psnr_aligned", "ssim_aligned", "lpips_alex", "lpips_alex_aligned"} <= here.keys()
    assert len(shown) == views > 5
    for name in here["per_image"]:
        assert there["per_image"][name] == pytest.approx(here["per_image"][name], rel=1e-4), name
    assert 20 < here["psnr"] < 40 and here["psnr_aligned"] > here["psnr"] and 0 < here["lpips_alex"] < 10


def test_meshers_get_maps_of_the_cpu(sight, made):
    with simulated_gpu():
        drawn = with_drawing(made, OnSimulatedGpu(sight.rasterizer))
        view = sight.views[0]
        assert is_there(drawn.draw_there(view).depth) and is_there(drawn.draw_color(view).color)
        assert not any(map(is_there, drawn.draw(view).present().values()))


def test_lpips_waits_once(made):
    a, b = torch.rand(2, 3, 64, 48, generator=torch.Generator().manual_seed(3))
    wanted = network("cpu").distance(a, b)
    with simulated_gpu() as gpu:
        found = network(GPU).distance(a.to(GPU), b.to(GPU))
        assert sum(gpu.waits.values()) == 1
    assert found == pytest.approx(wanted, rel=1e-6) and wanted > 0


@pytest.mark.parametrize("assign", [SSIMDifference(), PictureShare()])
def test_views_are_assigned_on_the_gpu(sight, assign):
    owner = (sight.splats.means[:, 0] > 0).long()
    wanted = assign.measure(sight, owner, 2)
    with simulated_gpu() as gpu:
        there = replace(sight, rasterizer=OnSimulatedGpu(sight.rasterizer))
        found = assign.measure(there, owner, 2)
        ours = {name: count for name, count in gpu.waits.items() if name != "to cpu"}
        assert gpu.peak > 3 * 4 * 72 * 60 or assign != SSIMDifference(), "pictures are compared there"
    assert not is_there(found) and torch.allclose(found, wanted, atol=1e-5) and (wanted > 0.01).any()
    assert sum(ours.values()) <= 3 * len(sight.views), f"{ours}: not for each block"


def test_contributions_are_summed_on_the_gpu(sight):
    wanted = ViewContributions(sight.views, sight.rasterizer, sight.splats, sight.near).contributions()
    with simulated_gpu() as gpu:
        splats = sight.splats.to(GPU)
        gpu.waits.clear()
        found = ViewContributions(sight.views, OnSimulatedGpu(sight.rasterizer), splats, sight.near).contributions()
        assert set(gpu.waits) <= {"to cpu"}, "those are of the rasterizer that stands in"
        assert all(map(is_there, vars(found).values()))
        for name, value in vars(found).items():
            assert torch.allclose(value.cpu(), vars(wanted)[name]), name
