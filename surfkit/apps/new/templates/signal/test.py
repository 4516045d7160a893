import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_the_weighted_sum():
    chosen, total = torch.tensor([[4.0, 0.0]]), torch.tensor([[0.0, 8.0]])
    assert NewPart(share=0.25).combine(chosen, total).tolist() == [[1.0, 6.0]]


def test_it_refuses_a_share_beyond_1():
    with pytest.raises(BadInput, match="0 to 1"):
        NewPart(share=1.5)
