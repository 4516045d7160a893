import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_it_keeps_the_digits_of_positions():
    with pytest.raises(BadInput, match="positions need more digits"):
        NewPart(half=("means",))
