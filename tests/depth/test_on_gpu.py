"""Depth maps on a GPU that is simulated: the same as on the CPU."""

from dataclasses import replace

import pytest
import torch

from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.testing.inputs import depth_input
from surfkit.testing.simulated_gpu import GPU, simulated_gpu


@pytest.mark.parametrize(
    "estimator", [PlaneSweep(), PatchMatch(neighbours=6, passes=1)], ids=["plane-sweep", "patch-match"]
)
def test_same_maps_as_on_the_cpu(estimator, tmp_path):
    (tmp_path / "there").mkdir()
    given, _ = depth_input(tmp_path)
    here = list(estimator.estimate(given, [4]))
    with simulated_gpu():
        there = list(estimator.estimate(replace(given, device=GPU, work=tmp_path / "there"), [4]))
        found = [each.cpu() for each in (there[0].inverse, there[0].confidence)]
    torch.testing.assert_close(found, [here[0].inverse, here[0].confidence], rtol=1e-4, atol=1e-5)
