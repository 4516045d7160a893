from types import SimpleNamespace

import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart(largest=0.2, every=50))


def test_it_removes_the_large_points():
    scales = torch.tensor([[0.01, 0.02], [0.3, 0.01], [0.04, 0.06]])
    step = SimpleNamespace(index=100, splats=SimpleNamespace(scales=scales))
    assert NewPart(largest=0.05).edit(None, step).drop.tolist() == [False, True, True]
    assert NewPart(largest=0.05, every=30).edit(None, step) is None


def test_it_refuses_a_size_of_nothing():
    with pytest.raises(BadInput, match="give more than 0"):
        NewPart(largest=0)
