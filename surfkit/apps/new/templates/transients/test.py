from types import SimpleNamespace

import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart(start=0))


def test_what_is_far_off_is_left_out_after_the_first_steps():
    color, photo = torch.zeros(3, 2, 2), torch.zeros(3, 2, 2)
    photo[1, 0, 1] = 0.9
    target = SimpleNamespace(photo=photo)
    assert NewPart(start=10).kept(color, target, 10, 100) is None
    assert NewPart(start=10).kept(color, target, 11, 100).tolist() == [[True, False], [True, True]]


def test_it_refuses_a_limit_of_0():
    with pytest.raises(BadInput, match="must be more than 0"):
        NewPart(limit=0)
