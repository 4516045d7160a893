import math

import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import SH0, NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_points_become_as_bright_as_the_mean_photograph():
    params = {"sh0": torch.tensor([[[-0.5, 0.0, 0.5]]]), "sh_rest": torch.zeros(1, 0, 3)}
    folded = NewPart().folded(torch.full((2, 3), math.log(2.0)), params)
    assert torch.allclose(0.5 + SH0 * folded["sh0"], 2 * (0.5 + SH0 * params["sh0"]))


def test_it_refuses_a_rate_of_0():
    with pytest.raises(BadInput, match="must be above 0"):
        NewPart(end=0)
