"""The CUDA kernels in the emulator, which refuses races and wrong indices, against the reference in float64."""

import shutil
from dataclasses import dataclass
from functools import cache

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.raster.api import MAPS, STANDARD, Maps
from surfkit.raster.base import Rasterizer
from surfkit.raster.cuda.rasterizer import TileRasterizer, source
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.raster.reference import Reference

from .cases import case, different_gradients, different_maps
from .scenes import CASES, NEAR, Draw, double, make

pytestmark = pytest.mark.skipif(
    not any(shutil.which(name) for name in ("g++", "c++", "clang++")), reason="the emulator needs a C++ compiler"
)
SOME = {"gaussian": ("plain", "needle", "around", "antialias"), "plane": ("plain", "grazing")}
SOME |= {"ray": ("plain", "needle", "edge_on"), "solid": ("plain", "needle", "opaque")}
each_case = pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name, kind in CASES if name in SOME.get(kind, (name,))]
)
each_kind = pytest.mark.parametrize("kind", ("surfel", "gaussian", "ray"))


@cache
def emulated(name: str, seed: int, **defines: int) -> Emulated:
    return Emulated(source(name, **defines), seed=seed)


@dataclass(frozen=True)
class EmulatedRasterizer(TileRasterizer):
    """Draws with the CUDA kernels on the CPU; `seed` permutes the order of blocks and threads."""

    seed: int = 0

    def title(self) -> str:
        return "cuda, emulated"

    def where(self) -> torch.device:
        return torch.device("cpu")

    def program(self, name: str, **defines: int) -> Emulated:
        return emulated(name, self.seed, **defines)


CUDA: Rasterizer = EmulatedRasterizer()


@each_case
def test_maps_and_gradients_equal_the_reference(name, kind):
    c = case(name, kind)
    render = CUDA.render(c.splats, c.view, NEAR)
    assert not different_maps(render.maps, c.true.maps, c.clear)
    assert not (c.true.seen & ~render.seen).any()
    error = (render.radii - c.true.radii).abs()[c.true.seen]
    assert (error <= 1e-2 + 1e-3 * c.true.radii[c.true.seen]).all() and not render.radii[~render.seen].any()
    total, chosen = Maps(**c.cotangents), Maps(color=c.cotangents["color"])
    assert not different_gradients(render.backward(total, chosen), c.true.backward(total, chosen), c.allowed)


@pytest.mark.parametrize("degree", (1, 2))
def test_degrees_of_the_colour(degree):
    c = case("plain", "surfel", degree)
    render, total = CUDA.render(c.splats, c.view, NEAR), Maps(**c.cotangents)
    assert not different_maps(render.maps, c.true.maps, c.clear)
    assert not different_gradients(render.backward(total, total), c.true.backward(total, total))


def test_absolute_signals_equal_the_reference():
    c = case("needle", "surfel")
    render, total = CUDA.render(c.splats, c.view, NEAR), Maps(**c.cotangents)
    found, true = (each.backward(total, total, absolute=True) for each in (render, c.true))
    assert not different_gradients(found, true)
    assert not torch.allclose(found.chosen.abs(), render.backward(total, total).chosen.abs(), rtol=0.01)


def test_gradients_of_the_first_rows_are_those_of_all():
    c = case("plain", "surfel")
    render, total, rows = CUDA.render(c.splats, c.view, NEAR), Maps(**c.cotangents), len(c.splats) // 2
    whole, part = (render.backward(total, total, rows=count) for count in (None, rows))
    for key in (*STANDARD, "signal", "chosen"):
        assert torch.equal(getattr(part, key), getattr(whole, key)[:rows]), key
    assert render.backward(total, rows=0).means.shape == (0, 3)


def test_fewer_maps_are_the_same_maps():
    c = case("faint", "surfel")
    whole, only = CUDA.render(c.splats, c.view, NEAR), Maps(color=c.cotangents["color"], alpha=c.cotangents["alpha"])
    for wanted, names in (({"distortion": False}, MAPS[:5]), ({"geometry": False}, MAPS[:2])):
        render = CUDA.render(c.splats, c.view, NEAR, **wanted)
        assert tuple(render.maps.present()) == names
        for key, value in render.maps.present().items():
            assert torch.equal(value, getattr(whole.maps, key)), key
        assert not different_gradients(render.backward(only), whole.backward(only))
    with pytest.raises(BadInput, match="cotangent of depth"):
        render.backward(Maps(depth=c.cotangents["depth"]))


@each_kind
def test_contributions_equal_the_reference(kind):
    c = case("plain", kind)
    near = int((~c.clear).sum())  # pixels at which either may count one more or less
    for powers in ((0.5, 0.5), (0.8, 0.3)):
        total, count = CUDA.contribution(c.splats, c.view, NEAR, *powers)
        true_total, true_count = Reference().contribution(double(c.splats), c.view, NEAR, *powers)
        assert ((count - true_count).abs() <= near).all() and count.sum() > 1000
        assert ((total - true_total).abs() <= 1e-4 * (1 + true_total) + near).all()


@each_kind
def test_opacity_before_points_equals_the_native_one(kind):
    c = case("plain", kind)
    draws = Draw(3)
    points = torch.cat([c.splats.means.double().repeat(3, 1) + 0.1 * draws.normal(3 * len(c.splats), 3)])
    found, native = (each.opacity_before(c.splats, c.view, NEAR, points) for each in (CUDA, NativeRasterizer()))
    assert torch.equal(found.isnan(), native.isnan()) and 20 < (~found.isnan()).sum() < len(points)
    assert (found - native).abs().nan_to_num().max() < 1e-5 and found.nan_to_num().max() > 0.5


@each_kind
def test_the_order_of_threads_does_not_change_a_bit(kind):
    c = case("opaque" if kind == "surfel" else "plain", kind)
    total, found = Maps(**c.cotangents), []
    for rasterizer in (CUDA, EmulatedRasterizer(seed=5)):
        render = rasterizer.render(c.splats, c.view, NEAR)
        found.append({**render.maps.present(), **render.backward(total, Maps(color=total.color)).tensors()})
    assert all(torch.equal(value, found[1][key]) for key, value in found[0].items())


def test_nothing_in_view():
    shown, view = make("plain", "surfel")
    away = type(shown)(**{**vars(shown), "means": shown.means + 1e4})
    render = CUDA.render(away, view, NEAR)
    assert not render.seen.any() and not any(value.any() for value in render.maps.present().values())
    ones = Maps(color=torch.ones_like(render.maps.color))
    assert not any(value.any() for value in render.backward(ones, ones).tensors().values())
    assert not CUDA.contribution(away, view, NEAR, 0.5, 0.5)[1].any()


def test_wrong_values_are_refused():
    shown, view = make("plain", "surfel")
    scales = shown.scales.clone()
    scales[3, 1] = -1
    with pytest.raises(BadInput, match="splats.scales: 1 of .*positive.*row 3"):
        CUDA.render(type(shown)(**{**vars(shown), "scales": scales}), view, NEAR)
