import numpy as np
import pytest
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart, facing, one_per_cell


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_a_cell_keeps_the_point_of_middle_height():
    places = np.array([[0.1, 0.1, 5.0], [0.2, 0.3, 1.0], [0.3, 0.2, 9.0], [1.5, 0.1, 2.0]])
    assert one_per_cell(places, 1.0).tolist() == [0, 3]


def test_triangles_face_the_cameras():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert facing(vertices, np.array([[0, 2, 1]]), np.array([0, 0, 5.0])).tolist() == [[1, 2, 0]]


def test_it_refuses_cells_of_nothing():
    with pytest.raises(BadInput, match="must be more than 0"):
        NewPart(cell=0)
