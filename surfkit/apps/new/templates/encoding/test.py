import pytest
import torch
from surfkit.plugin import BadInput, ColumnType, IDENTITY, Leaf
from surfkit.testing import check

from new_plugin.new_part import NewPart, NewPartFiles


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_files_with_it_are_whole():
    check(NewPartFiles())


def test_small_numbers_keep_more_digits():
    values = {"sh0": torch.tensor([[0.01, -0.0004, 4.0], [-1.0, 0.0, 0.25]])}
    kinds, leaf = {"sh0": ColumnType((3,), torch.float32, IDENTITY)}, Leaf(0, (0, 0, 0), 0)
    encoding = NewPart(step=0.03)
    found = encoding.decode(encoding.encode(values, kinds, leaf, {}), kinds, leaf, 2, {})["sh0"]
    assert torch.equal(found.sign(), values["sh0"].sign())
    off = (found.abs().sqrt() - values["sh0"].abs().sqrt()).abs()
    assert off.max() <= 0.03 / 2 + 1e-6


def test_a_step_without_sense_is_refused():
    with pytest.raises(BadInput, match="new-part.step is 0; it must be above 0"):
        NewPart(step=0.0)
