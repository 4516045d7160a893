import numpy as np
import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check
from surfkit.testing.inputs import lod_input

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_levels_lack_the_smallest_splats():
    given = lod_input()
    tree = NewPart(keep=(0.25,)).build(given)
    full, coarse = (level.splats.scales.amax(1).detach() for level in tree.levels)
    count = len(given.model) // 4
    assert len(coarse) == count and np.array_equal(tree.blocks.parent, [-1, 0])
    assert coarse.min() >= full[count:].max() == pytest.approx(tree.blocks.error[0])


def test_shares_that_do_not_fall_are_refused():
    with pytest.raises(BadInput, match="give shares between 1 and 0 that fall"):
        NewPart(keep=(0.25, 0.5))
