"""The CUDA kernels on a GPU, against the reference in float64."""

import pytest
import torch

from surfkit.raster.api import Maps
from surfkit.raster.cuda.gpu import CudaRasterizer
from surfkit.testing import check_rasterizer

from .cases import case, different_gradients, different_maps
from .scenes import CASES, NEAR

WHY = CudaRasterizer().missing()
pytestmark = [pytest.mark.cuda, pytest.mark.skipif(WHY is not None, reason=str(WHY))]


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_maps_and_gradients_equal_the_reference(name, kind):
    c = case(name, kind)
    render = CudaRasterizer().render(c.splats, c.view, NEAR)
    assert not different_maps(render.maps, c.true.maps, c.clear)
    total, chosen = Maps(**c.cotangents), Maps(color=c.cotangents["color"])
    assert not different_gradients(render.backward(total, chosen), c.true.backward(total, chosen), c.allowed)


def test_contract():
    check_rasterizer(CudaRasterizer())


@pytest.mark.parametrize("kind", ["surfel", "gaussian"])
def test_twice_the_same_bits(kind):
    c = case("plain", kind)
    twice = []
    for _ in range(2):
        render = CudaRasterizer().render(c.splats, c.view, NEAR)
        found = render.backward(Maps(**c.cotangents), Maps(color=c.cotangents["color"]))
        twice.append([*render.maps.present().values(), *found.tensors().values(), found.signal, found.chosen])
    assert all(torch.equal(a, b) for a, b in zip(*twice, strict=True))


def test_splats_of_the_cpu_are_copied_once():
    c = case("plain", "surfel")
    CudaRasterizer().render(c.splats, c.view, NEAR).maps  # noqa: B018
    before = torch.cuda.memory_allocated()
    for _ in range(3):
        assert CudaRasterizer().render(c.splats, c.view, NEAR, False, False).maps.color.device.type == "cpu"
    assert torch.cuda.memory_allocated() <= before
