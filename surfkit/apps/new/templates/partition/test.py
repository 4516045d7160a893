import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check
from surfkit.testing.scenes import coarse_model

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart(blocks=3))


def test_strips_have_equally_many_cameras():
    sight = coarse_model()
    counts = NewPart(blocks=5).cells(sight).owner(sight.centres).bincount()
    assert counts.tolist() == [6, 6, 6, 6, 6]


def test_it_refuses_no_strips():
    with pytest.raises(BadInput, match="must be 1 or more"):
        NewPart(blocks=0)
