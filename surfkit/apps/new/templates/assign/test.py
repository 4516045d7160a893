import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check
from surfkit.testing.scenes import coarse_model

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_the_shares_of_a_view_are_1_together():
    sight = coarse_model()
    owner = torch.arange(len(sight.splats.means)) % 3
    assert torch.allclose(NewPart().measure(sight, owner, 3).sum(1), torch.ones(len(sight.views)))


def test_it_refuses_a_share_of_1():
    with pytest.raises(BadInput, match="below 1"):
        NewPart(threshold=1)
