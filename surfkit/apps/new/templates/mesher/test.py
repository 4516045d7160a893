import numpy as np
import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart, smoothed


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_a_rough_plane_becomes_smoother():
    x, y = (axis.reshape(-1) for axis in np.meshgrid(np.arange(20), np.arange(20)))
    first = (x + 20 * y)[(x < 19) & (y < 19)][:, None]
    faces = np.concatenate([first + [0, 1, 20], first + [1, 21, 20]])
    rough = np.stack([x, y, np.random.default_rng(0).normal(0, 0.1, 400)], axis=1).astype(np.float32)
    smooth = smoothed(rough, faces, 10)
    assert smooth[:, 2].std() < 0.6 * rough[:, 2].std()
    assert np.ptp(smooth[:, 0]) > 0.95 * 19, "it does not shrink"
    assert np.array_equal(smoothed(rough, faces, 0), rough)


def test_it_refuses_a_number_below_0():
    with pytest.raises(BadInput, match="must be 0 or more"):
        NewPart(passes=-1)
