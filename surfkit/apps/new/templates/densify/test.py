import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart(start=10, until=180, every=10))


def test_the_steps_of_its_edits():
    assert list(NewPart(start=100, until=450, every=100).edits(1_000)) == [200, 300, 400]
    assert list(NewPart(start=100, until=450, every=100).edits(250)) == [200]


def test_it_refuses_a_share_of_0():
    with pytest.raises(BadInput, match="give 0 to 1"):
        NewPart(share=0)
