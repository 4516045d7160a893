"""How large the map of a photograph will be, as it is told before any is made."""

import pytest
import torch

from surfkit.depth.filled import Filled
from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.scene.camera import Camera
from surfkit.testing.inputs import depth_input

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 3_000.0, 3_000.0, 2_000.0, 1_500.0, 4_000, 3_000)


@pytest.mark.parametrize(
    ("estimator", "size"),
    [
        (PatchMatch(), (1_600, 1_200)),
        (PatchMatch(scale=4), (1_000, 750)),
        (PlaneSweep(), (480, 360)),
        (Filled(stereo=PatchMatch(longest=800)), (800, 600)),
    ],
)
def test_maps_are_smaller_than_large_photographs(estimator, size):
    told = estimator.of_map(CAMERA)
    assert (told.width, told.height) == size


@pytest.mark.parametrize("stereo", [PlaneSweep(longest=40), PatchMatch(longest=40)])
def test_filled_maps_have_the_size_of_those_of_stereo(stereo, tmp_path):
    given, _ = depth_input(tmp_path)
    told = Filled(stereo=stereo).of_map(given.views[4].camera)
    (made,) = Filled(stereo=stereo).estimate(given, [4])
    assert made.inverse.shape == (told.height, told.width) == (30, 40)
