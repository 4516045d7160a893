import numpy as np
import pytest
import torch
from surfkit.plugin import BadInput
from surfkit.testing import check

from new_plugin.new_part import NewPart


def test_it_keeps_the_contract_of_its_kind():
    check(NewPart())


def test_the_corners_of_a_rectangle_are_found():
    photo = torch.zeros((3, 60, 80), dtype=torch.uint8)
    photo[:, 20:40, 30:60] = 200
    found = NewPart().opened(4, torch.device("cpu"))(photo).keypoints[:, :2]
    for corner in ((30, 20), (60, 20), (30, 40), (60, 40)):
        assert np.linalg.norm(found - corner, axis=1).min() < 3


def test_it_refuses_no_pixels():
    with pytest.raises(BadInput, match="must be 2 or more"):
        NewPart(radius=1)
