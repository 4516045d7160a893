import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_it_refuses_maps_without_pixels():
    with pytest.raises(BadInput, match="give 1 or more"):
        NewPart(longest=0)
