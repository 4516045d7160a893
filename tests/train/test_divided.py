"""Two processes that train one model, against one that has all of it."""

from dataclasses import replace

import pytest
import torch
from several_processes import crowd, drawn, drawn_together, in_processes

from surfkit.raster.native_rasterizer import NativeRasterizer

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.parametrize("kind, geometry", [("surfel", "axis"), ("gaussian", "axis"), ("gaussian", "ray")])
def test_two_processes_draw_the_picture_of_one_and_get_its_gradients(kind, geometry):
    splats = crowd(kind, geometry)
    # the lower half is fuller, so that the strips move
    splats = replace(splats, means=splats.means + torch.tensor([0, 0.2, 0]))
    one, (two, other) = drawn(NativeRasterizer(), splats), in_processes(drawn_together, splats)
    assert two[1] == [(0, 4), (4, 7)] or two[1] == [(0, 3), (3, 7)]
    assert two[2] == other[2] and two[2] != two[1] and two[2][-1][1] == 7
    for name, value in one.items():
        both = two[0][name] if name.startswith("map") else torch.cat([two[0][name], other[0][name]])
        if name.startswith("by"):
            assert (both - value).norm() <= 1e-6 * value.norm() and value.norm() > 0, name
        else:
            assert torch.equal(both, value), name
        assert not name.startswith("map") or torch.equal(other[0][name], value)
