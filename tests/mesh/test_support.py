"""Gaps between the faces that views confirm, against the closing of a picture."""

import numpy as np
import pytest
from scipy import ndimage

from surfkit.mesh import support
from surfkit.mesh.support import closed, supported

SIDE = 60


def plane():
    """Faces of a flat square, two for each cell, with their middles and cells."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    at = (x * (SIDE + 1) + y).ravel()
    one = np.stack([at, at + SIDE + 1, at + 1], 1)
    other = np.stack([at + 1, at + SIDE + 1, at + SIDE + 2], 1)
    places = np.stack(np.divmod(np.arange((SIDE + 1) ** 2), SIDE + 1), 1) * 1.0
    faces = np.concatenate([one, other])
    return np.column_stack([places[faces].mean(1), np.zeros(len(faces))]), faces, np.tile(np.arange(SIDE**2), 2)


def closed_cells(sure, width):
    middles, faces, cells = plane()
    kept = closed(sure.ravel()[cells], middles, faces, width / 2)
    return kept.reshape(2, SIDE, SIDE).all(0), kept.reshape(2, SIDE, SIDE).any(0)


@pytest.mark.parametrize(("width", "closes"), [(4, False), (12, True)])
def test_a_gap_is_closed_up_to_a_width(width, closes):
    sure = np.ones((SIDE, SIDE), bool)
    sure[20:28, 20:28] = False
    all_, any_ = closed_cells(sure, width)
    assert (all_[sure]).all() and all_[22:26, 22:26].all() == closes == any_[22:26, 22:26].any()


def test_a_bay_at_the_rim_is_filled_and_beyond_it_nothing_is_added():
    """As a disc closes the picture, but for a cell or two: distances go from middle to middle of triangles."""
    sure = np.zeros((SIDE, SIDE), bool)
    sure[10:50, 10:50] = True
    sure[10:16, 28:32] = sure[10:30, 14:26] = False  # narrow, and wide
    all_, any_ = closed_cells(sure, 9.0)
    x, y = np.ogrid[-5:6, -5:6]
    disc = np.hypot(x, y) <= 4.5
    wanted = ndimage.binary_closing(np.pad(sure, 10), disc)[10:-10, 10:-10]
    assert wanted[14, 30] and not wanted[18, 20] and not wanted[9, 30]
    near = ndimage.binary_dilation(wanted, iterations=2) & ~ndimage.binary_erosion(wanted, iterations=2)
    assert (all_ == wanted)[~near].all() and (any_ == wanted)[~near].all()
    assert all_[14:16, 29:31].all() and not any_[:9].any()


def test_the_end_of_the_surface_is_outside():
    """What is not sure at the end of the surface is not kept, however wide gaps may be."""
    sure = np.ones((SIDE, SIDE), bool)
    sure[:3] = False
    _, any_ = closed_cells(sure, 20)
    assert not any_[0].any() and not any_[1].any()


def test_nothing_is_sure():
    all_, any_ = closed_cells(np.zeros((SIDE, SIDE), bool), 1e6)
    assert not any_.any() and not all_.any()


def test_a_large_face_is_confirmed_at_several_places(monkeypatch):
    """The middle of a sliver along the rim may lie on ground that views see, and its ends beside it."""
    points = np.array([[0, 0, 0], [40, 0, 0], [20, 30, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    faces, looked = np.array([[0, 1, 2], [0, 3, 4]]), []

    def disc(sights, places, normals, side):
        looked.append((places, normals))
        return np.where(np.linalg.norm(places - (20, 10, 0), axis=1) < sights, 3.0, 0.0).astype(np.float32)

    monkeypatch.setattr(support, "confirming", disc)
    assert supported(100.0, points, faces, 1.0, 2, 0.0).tolist() == [True, True]
    assert supported(19.9, points, faces, 1.0, 2, 0.0).tolist() == [True, False], "all places of the large one are seen"
    assert supported(8.0, points, faces, 1.0, 2, 0.0).tolist() == [False, False]
    (places, normals), *_ = looked
    assert len(places) == 2 + 6 and (normals == (0, 0, 1)).all() and np.allclose(places[[0, 2, 3]].mean(0)[2], 0)
    assert supported(8.0, points, faces, 3.0, 2, 0.0).tolist() == [True, False], "at larger cells it is a small face"
