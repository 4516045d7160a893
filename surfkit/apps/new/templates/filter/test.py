from types import SimpleNamespace

import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_it_admits_opaque_points_only():
    step = SimpleNamespace(splats=SimpleNamespace(opacities=torch.tensor([0.01, 0.5])))
    assert NewPart(least=0.1).admits(step, torch.ones(2)).tolist() == [False, True]


def test_it_refuses_an_opacity_of_1():
    with pytest.raises(BadInput, match="below 1"):
        NewPart(least=1.0)
