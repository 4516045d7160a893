from types import SimpleNamespace

import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_it_holds_out_by_name():
    capture = SimpleNamespace(shots=[SimpleNamespace(name=name) for name in ("d", "a", "c", "b")])
    assert list(NewPart(every=2, first=1).held_out(capture)) == ["b", "d"]


def test_it_refuses_to_hold_out_everything():
    with pytest.raises(BadInput, match="give 2 or more"):
        NewPart(every=1)
