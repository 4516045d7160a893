import math
from types import SimpleNamespace

import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_only_needles_count():
    splats = SimpleNamespace(scales=torch.tensor([[1.0, 0.5], [0.01, 1.0]]))
    assert float(NewPart(ratio=10.0)(splats)) == pytest.approx(math.log(10) / 2)


def test_it_refuses_a_ratio_below_1():
    with pytest.raises(BadInput, match="must be 1 or more"):
        NewPart(ratio=0.5)
