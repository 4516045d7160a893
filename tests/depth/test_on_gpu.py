"""Depth maps on a GPU that is simulated: the same as on the CPU."""

from dataclasses import replace

import torch

from surfkit.depth.patch_match import PatchMatch
from surfkit.depth.plane_sweep import PlaneSweep
from surfkit.testing.inputs import depth_input
from surfkit.testing.simulated_gpu import GPU, simulated_gpu


def both(estimator, folder):
    """Estimates of one view on the CPU and on the simulated GPU."""
    (folder / "there").mkdir()
    given, truth = depth_input(folder)
    (here,) = estimator.estimate(given, [4])
    with simulated_gpu():
        (there,) = estimator.estimate(replace(given, device=GPU, work=folder / "there"), [4])
    return here, there, truth.exact[given.views[4].name].depth.float()


def test_plane_sweep_has_the_same_maps_as_on_the_cpu(tmp_path):
    here, there, _ = both(PlaneSweep(), tmp_path)
    found = [there.inverse, there.confidence]
    torch.testing.assert_close(found, [here.inverse, here.confidence], rtol=1e-4, atol=1e-5)


def test_patch_match_has_maps_as_good_as_on_the_cpu(tmp_path):
    """Of planes that match equally well, either may be taken, and neighbours go on from it."""
    here, there, depth = both(PatchMatch(neighbours=3, passes=1, rounds=1), tmp_path)
    shown = depth > 0
    right = [float(((1 / (each.inverse * depth) - 1).abs() < 0.02)[shown].float().mean()) for each in (here, there)]
    assert right[0] > 0.3 and abs(right[1] - right[0]) < 0.02
    assert not there.inverse.equal(here.inverse)
