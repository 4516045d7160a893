import pytest
import torch
from surfkit.plugin import BadInput, Camera, FillInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_a_small_hole_gets_the_depth_around_it_and_a_large_one_none_in_the_middle():
    camera = Camera(torch.eye(4, dtype=torch.float64), 50.0, 50.0, 30.0, 30.0, 60, 60)
    for half, filled in ((3, True), (20, False)):
        inverse = torch.full((60, 60), 0.5)
        inverse[30 - half : 30 + half, 30 - half : 30 + half] = 0
        given = FillInput(0, torch.zeros(3, 60, 60), camera, inverse, (inverse > 0).float())
        found = NewPart().means(given)[30, 30]
        assert (abs(float(found) - 0.5) < 1e-6) if filled else found == 0


def test_it_refuses_a_reach_of_nothing():
    with pytest.raises(BadInput, match="more than 0"):
        NewPart(reach=0.0)
