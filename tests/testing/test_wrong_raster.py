"""Rasterizers that break their contract are named, with what is wrong."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch

from surfkit.raster.base import Rasterizer
from surfkit.raster.reference import Reference
from surfkit.testing import check_rasterizer


@dataclass(frozen=True)
class Own(Rasterizer):
    """The reference, spoilt."""

    def title(self):
        return "own"

    def render(self, splats, camera, near, geometry=True, distortion=True):
        return self.spoilt(Reference().render(splats, camera, near, geometry, distortion))

    def contribution(self, splats, camera, near, alpha_power, transmittance_power):
        return Reference().contribution(splats, camera, near, alpha_power, transmittance_power)

    def opacity_before(self, splats, camera, near, points):
        return Reference().opacity_before(splats, camera, near, points)

    def spoilt(self, render):
        return render


def view(render, **changes):
    return SimpleNamespace(**{"maps": render.maps, "seen": render.seen, "radii": render.radii} | changes)


class Upside(Own):
    def spoilt(self, render):
        return view(render, maps=replace(render.maps, color=render.maps.color.flip(1)), backward=render.backward)


class Halves(Own):
    def spoilt(self, render):
        def backward(*given, **more):
            gradients = render.backward(*given, **more)
            return replace(gradients, opacities=gradients.opacities / 2)

        return view(render, backward=backward)


class Flat(Own):
    def spoilt(self, render):
        return view(render, maps=replace(render.maps, normal=None), backward=render.backward)


class Noisy(Own):
    def spoilt(self, render):
        noise = 1e-5 * torch.rand(render.maps.color.shape)
        return view(render, maps=replace(render.maps, color=render.maps.color + noise), backward=render.backward)


class Lenient(Own):
    def render(self, splats, camera, near, geometry=True, distortion=True):
        return Own.render(self, replace(splats, means=splats.means.nan_to_num()), camera, near, geometry, distortion)


class Counts(Own):
    def contribution(self, splats, camera, near, alpha_power, transmittance_power):
        total, count = Own.contribution(self, splats, camera, near, alpha_power, transmittance_power)
        return total / count.clamp_min(1), count


class Loud(Own):
    def leading(self, splats, camera, near):
        return Reference().leading(splats, camera, near) + 9


class Blind(Own):
    def spoilt(self, render):
        nobody = torch.zeros_like(render.seen)
        return view(render, seen=nobody, radii=render.radii * nobody, backward=render.backward)


class Narrow(Own):
    def in_view(self, splats, camera, near):
        return super().in_view(splats, camera, near) & (torch.arange(len(splats)) > 5)


class Closed(Own):
    def boxes_in_view(self, boxes, camera, near):
        return torch.arange(len(boxes)) > 0


@pytest.mark.parametrize(
    ("rasterizer", "message"),
    [
        (Upside(), r"Upside of surfels: 'color': \d+%"),
        (Halves(), "Halves of surfels: .*'opacities' .*50%"),
        (Flat(), "Flat of surfels: the map 'normal' is not there"),
        (Noisy(), "Noisy.render is not repeatable: color"),
        (Lenient(), "Lenient draws .*NaN"),
        (Counts(), r"Counts of surfels: .*contribution: \d+%"),
        (Loud(), r"Loud of surfels: leading: \d+%"),
        (Narrow(), r"Narrow of surfels: \d+ .*`in_view`"),
        (Closed(), r"Closed of surfels: 4 .*`boxes_in_view`"),
        (Blind(), r"Blind of surfels: \d+ .*`seen`"),
    ],
)
def test_rasterizers_that_are_wrong(rasterizer, message):
    with pytest.raises(AssertionError, match=message):
        check_rasterizer(rasterizer)


def test_a_rasterizer_that_is_right():
    check_rasterizer(Own())
