import numpy as np
import pytest
from surfkit.plugin import BadInput, DepthQuery
from surfkit.testing import check

from new_plugin.new_part import NewPart


@pytest.fixture
def query(tmp_path):
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps" / "a.npy", np.full((4, 6), 2.0, np.float32))
    return DepthQuery(tmp_path, ["a.jpg"], tmp_path)


def test_it_keeps_the_contract_of_its_kind(query):
    check(NewPart(folder="maps"), query)


def test_depths_become_inverse_depths(query):
    assert np.array_equal(NewPart(folder="maps").find(query)["a.jpg"].read(), np.full((4, 6), 0.5, np.float32))


def test_it_refuses_a_folder_elsewhere():
    with pytest.raises(BadInput, match="relative"):
        NewPart(folder="/maps")
