from types import SimpleNamespace

import pytest
import torch
from surfkit.plugin import BadInput, Maps
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_its_value():
    maps, target = Maps(color=torch.full((3, 2, 2), 0.75)), SimpleNamespace(photo=torch.zeros(3, 2, 2))
    assert float(NewPart(epsilon=1.0)(maps, target)) == pytest.approx(1.25)


def test_it_refuses_an_epsilon_of_0():
    with pytest.raises(BadInput, match="must be more than 0"):
        NewPart(epsilon=0)
