"""What a camera may show, against what the reference sees."""

from dataclasses import replace

import pytest
import torch
from needs import needs_native

from surfkit.raster.culling import may_touch
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.reference import Reference

from .scenes import NEAR, PRIMITIVE_KINDS, Draw, camera, double, splats

FORMS = [("surfel", {}), *(("gaussian", {"geometry": geometry}) for geometry in ("axis", "plane", "ray"))]
FORMS += [("gaussian", {"dilation": 0.0}), ("gaussian", {"antialias": True, "dilation": 2.0})]
WAYS = {"torch": may_touch, "native": lambda *given: NativeRasterizer().in_view(*given)}
ways = pytest.mark.parametrize("way", ["torch", pytest.param("native", marks=needs_native)])


def around(kind: str, seed: int, count: int = 1200):
    """Splats on all sides of a camera, most of them small, many at the sides of the image."""
    draw = Draw(seed)
    view = camera(draw)
    centres = 1.5 * draw.normal(count, 3)
    edge = centres[: count // 3]  # to within a few pixels of a side
    edge[:, 2] = edge[:, 2].abs() + 0.2
    at = torch.tensor([0.0, view.width]).double()[draw.uniform(0, 2, len(edge)).long()] + 4 * draw.normal(len(edge))
    edge[:, 0] = (at - view.cx) / view.fx * edge[:, 2]
    scales = (0.8 * draw.normal(count, 2 if kind == "surfel" else 3) - 5).exp()
    return splats(draw, view, kind, 1, centres=centres, scales=scales, opacities=draw.uniform(0.2, 0.99, count)), view


@ways
@pytest.mark.parametrize(("kind", "form"), FORMS)
@pytest.mark.parametrize("seed", range(3))
def test_nothing_that_is_seen_is_left_out(way, kind, form, seed):
    made, view = around(kind, seed)
    made = replace(made, **form)
    found = WAYS[way](made, view, NEAR)
    seen = Reference().render(double(made), view, NEAR, geometry=False).seen
    assert 80 < int(seen.sum()) and not (seen & ~found).any()
    assert int(found.sum()) < 0.6 * len(made)


@needs_native
@pytest.mark.parametrize("kind", PRIMITIVE_KINDS)
def test_a_picture_is_the_same_without_the_others(kind):
    made, view = around(kind if kind in ("surfel", "gaussian") else "gaussian", 7)
    if kind == "ray":
        made = replace(made, geometry="ray")
    draws = NativeRasterizer()
    rows = draws.in_view(made, view, NEAR).nonzero()[:, 0]
    assert len(rows) < 0.7 * len(made)
    whole, part = draws.render(made, view, NEAR), draws.render(made.take(rows), view, NEAR)
    for name, value in whole.maps.present().items():
        assert torch.equal(value, getattr(part.maps, name)), name
    assert torch.equal(whole.seen[rows], part.seen) and torch.equal(whole.radii[rows], part.radii)


@ways
def test_what_lies_before_the_near_plane_or_behind_is_not_in_view(way):
    made, view = around("surfel", 1)
    z = (made.means.double() @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3])[:, 2]
    assert not WAYS[way](made, view, 1.0)[z < 0.99].any()


def test_a_rasterizer_that_does_not_tell_is_given_all():
    made, view = around("surfel", 1)
    assert Reference().in_view(made, view, NEAR).all()
