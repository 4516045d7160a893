import torch
from surfkit.plugin import Camera
from surfkit.raster.reference import Reference
from surfkit.raster.select import select
from surfkit.testing import check
from surfkit.testing.inputs import splats

from new_plugin.new_part import NewPart

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 40.0, 40.0, 20.0, 15.0, 40, 30)


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_it_draws_what_the_reference_draws_in_float64():
    given = splats("surfel", 30)
    double = given.with_named({name: value.double() for name, value in given.named().items()})
    found, true = (each.render(some, CAMERA, 0.01) for each, some in ((NewPart(), given), (Reference(), double)))
    assert found.maps.color.dtype == torch.float32
    assert torch.equal(found.maps.color, true.maps.color.float())


def test_it_draws_only_where_it_is_asked_for():
    assert not isinstance(select("auto")[0], NewPart)
