from types import SimpleNamespace

import pytest
import torch
from surfkit.plugin import BadInput, Points
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_two_steps_with_a_mean_that_turns_round():
    points, rates = Points.fresh({"means": torch.zeros(1, 3)}), {"means": 0.5}
    for index, gradient in enumerate(([1.0, -1.0, 4.0], [-3.0, -1.0, -1.0]), start=1):
        given = SimpleNamespace(index=index, rates=rates)
        NewPart(momentum=0.5).step(points, {"means": torch.tensor([gradient])}, given)
    assert points.params["means"].tolist() == [[0.0, 1.0, -1.0]]


def test_it_refuses_a_momentum_of_1():
    with pytest.raises(BadInput, match="less than 1"):
        NewPart(momentum=1.0)
