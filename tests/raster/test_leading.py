"""In which pixels a splat has both the largest weight and the median depth: the reference against a count in plain
Python, and the compiled kernels against the reference."""

from functools import cache

import numpy as np
import pytest
import torch
from needs import needs_native

from surfkit.core.check import BadInput
from surfkit.primitives.base import Primitive
from surfkit.primitives.drawing import PrimitiveRasterizer, draws_itself
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.reference import Reference, draw

from .cases import case
from .plain import evaluate
from .scenes import CASES, NEAR, PRIMITIVE_KINDS, axis_camera, crop, double, make, rows
from .test_cuda import EmulatedRasterizer
from .test_cuda import pytestmark as needs_compiler

each_case = pytest.mark.parametrize(("name", "kind"), CASES)
native = pytest.param(NativeRasterizer(), marks=needs_native, id="native")
cuda = pytest.param(EmulatedRasterizer(), marks=needs_compiler, id="cuda")
LARGE = 3
"""Pixels of a small scene that another rounding may count otherwise, beside those at a threshold: two weights that are
nearly equal."""


@cache
def small(name: str, kind: str):
    """Some 60 splats of a scene in float64, through a window of 24 x 20 pixels about the camera's axis."""
    drawn, view = make(name, kind)
    return rows(double(drawn), slice(0, 60)), crop(view, 24, 20, 16, 14)


@each_case
def test_the_reference_is_a_count_over_pixels(name, kind):
    """By the words of the paper, of what a plain loop blends."""
    shown, view = small(name, kind)
    near = int(draw(shown, view, NEAR).near_threshold.sum())  # pixels at which either may count one more or less
    pixels, wanted = {}, np.zeros(len(shown), dtype=int)
    for row, column, index, alpha, before in evaluate(shown, view, NEAR).blended:
        pixels.setdefault((row, column), []).append((index, alpha * before, before, before * (1 - alpha)))
    for blended in pixels.values():
        middle = [index for index, _, before, _ in blended if before > 0.5][-1]
        largest = max(blended, key=lambda one: one[1])[0]  # the first of equal ones
        wanted[middle] += largest == middle and blended[-1][3] <= 0.5
    found = Reference().leading(shown, view, NEAR)
    assert found.dtype == torch.int64 and np.abs(found.numpy() - wanted).max() <= near
    assert name not in ("plain", "opaque") or wanted.sum() > 20


def walls(opacities: list[float], kind: str) -> Splats:
    """One behind the other, each over the whole image with its opacity in every pixel."""
    count = len(opacities)
    means = torch.linspace(1, 2, count)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    scales = torch.tensor([1e4, 1e4, 1.0])[: 2 if kind == "surfel" else 3].expand(count, -1)
    turn = torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4)
    return Splats(kind, means, turn, scales, torch.tensor(opacities), torch.zeros(count, 1, 3))


@pytest.mark.parametrize("rasterizer", [pytest.param(Reference(), id="reference"), native, cuda])
@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_one_wall_behind_the_other(rasterizer, kind):
    def of(*opacities):
        return rasterizer.leading(walls(list(opacities), kind), axis_camera(24, 20), NEAR).tolist()

    assert of(0.6, 0.99) == [480, 0]
    assert of(0.3, 0.99) == [0, 480]
    assert of(0.2, 0.3, 0.5) == [0, 0, 480]
    assert of(0.4, 0.3, 0.9) == [0, 0, 0], "the first is the largest with 0.4, the second the median"
    assert of(0.4) == [0], "no median where more than half of the light passes"
    assert of(0.25, 1 / 3) == [0, 0], "of two weights of 0.25 the first counts; the second is the median"
    assert of(0.99, 0.99, 0.99, 0.99) == [480, 0, 0, 0]


@each_case
@pytest.mark.parametrize("rasterizer", [native])
def test_the_compiled_kernels_are_the_reference(rasterizer, name, kind):
    c = case(name, kind)
    found, true = (
        rasterizer.leading(c.splats, c.view, NEAR),
        Reference().leading(double(c.splats), c.view, NEAR),
    )
    near = int((~c.clear).sum()) + LARGE
    assert found.dtype == torch.int64 and (found - true).abs().max() <= near
    assert (found - true).abs().sum() <= 2 * near


@pytest.mark.parametrize("kind", (*PRIMITIVE_KINDS, "ray"))
@pytest.mark.parametrize("rasterizer", [cuda])
def test_the_kernels_of_a_gpu_are_the_reference(rasterizer, kind):
    c = case("plain", kind)
    found, true = rasterizer.leading(c.splats, c.view, NEAR), Reference().leading(double(c.splats), c.view, NEAR)
    assert (found - true).abs().sum() <= 2 * (int((~c.clear).sum()) + LARGE) and found.sum() > 300
    assert torch.equal(found, EmulatedRasterizer(seed=5).leading(c.splats, c.view, NEAR)), "the order of threads"
    away = type(c.splats)(**{**vars(c.splats), "means": c.splats.means + 1e4})
    assert not rasterizer.leading(away, c.view, NEAR).any()


class Silent(Reference):
    """Of another package, from before `leading`."""

    leading = Rasterizer.leading


class Many(Surfel2D):
    """Draws something else than its points."""

    contribution = lambda self, *given: Primitive.contribution(self, *given)  # noqa: E731


class Told(Many):
    """And says what leads."""

    def leading(self, splats, camera, rasterizer, near):
        return rasterizer.leading(splats, camera, near).flip(0)


def test_those_that_do_not_tell_say_so():
    view, wall = axis_camera(24, 20), walls([0.3, 0.99], "surfel")
    with pytest.raises(BadInput, match="rasterizer silent does not tell .* choose another densifier"):
        Silent().leading(wall, view, NEAR)
    with pytest.raises(BadInput, match="primitive many draws itself and does not tell .* choose another densifier"):
        PrimitiveRasterizer(Many(), Reference()).leading(wall, view, NEAR)
    assert PrimitiveRasterizer(Surfel2D(), Reference()).leading(wall, view, NEAR).tolist() == [0, 480]
    assert PrimitiveRasterizer(Told(), Reference()).leading(wall, view, NEAR).tolist() == [480, 0]
    assert draws_itself(Told()) and not draws_itself(Surfel2D())
