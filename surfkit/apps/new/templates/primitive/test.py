import torch
from surfkit.plugin import SparsePoints
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart(sh_degree=1))


def test_its_splats_are_round():
    cloud = SparsePoints(torch.rand(20, 3), torch.zeros(20, 3, dtype=torch.uint8))
    primitive = NewPart(sh_degree=0)
    splats = primitive.activate(primitive.init(cloud, torch.Generator().manual_seed(0)), 0)
    assert splats.scales.shape == (20, 3)
    assert torch.equal(splats.scales.amin(1), splats.scales.amax(1))
