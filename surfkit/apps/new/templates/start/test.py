import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_how_many_points_there_are():
    assert NewPart(share=0.25).expected(1_000, 0) == 250


def test_it_refuses_a_share_of_0():
    with pytest.raises(BadInput, match="more than 0"):
        NewPart(share=0)
