import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())
    check(NewPart(), "disk")


def test_it_refuses_a_distance_that_none_has():
    with pytest.raises(BadInput, match="must lie between 0 and 2"):
        NewPart(most=3)
