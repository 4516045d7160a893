from types import SimpleNamespace

import pytest
from surfkit.plugin import BadInput, Surfel2D
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_only_colours_have_a_learning_rate():
    rates = NewPart().stage.rates
    assert {name for name in Surfel2D().columns() if name not in rates} == {"sh0", "sh_rest"}
    assert not any(rate.start for rate in rates.values())


def test_it_refuses_a_primitive_without_colours():
    with pytest.raises(BadInput, match="does not have"):
        NewPart().refuse_unfit(SimpleNamespace(columns=dict))
