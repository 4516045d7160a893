import pytest
import torch
from surfkit.plugin import BadInput, Maps
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_faint_pixels_are_left_out():
    maps = Maps(alpha=torch.tensor([[0.25, 0.75]]))
    assert NewPart(least=0.5).within(maps, torch.ones(1, 2), None).tolist() == [[0.0, 0.75]]


def test_it_refuses_to_leave_out_everything():
    with pytest.raises(BadInput, match="below 1"):
        NewPart(least=1)
