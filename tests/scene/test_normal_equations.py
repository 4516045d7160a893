import numpy as np
import pytest
from scipy.sparse import bmat, coo_matrix, identity, kron
from scipy.sparse.linalg import splu

from surfkit.scene import normal_equations
from surfkit.scene.normal_equations import solved


def lattice(side, reach=3):
    """Of photographs in rows and strips that each share places with those up to `reach` away; positive definite."""
    at = np.arange(side * side).reshape(side, side)
    steps = [(i, j) for i in range(reach + 1) for j in range(-reach, reach + 1) if (i, j) > (0, 0)]
    pairs = [
        (at[: side - i, max(0, -j) : side - max(0, j)].ravel(), at[i:, max(0, j) : side + min(0, j)].ravel())
        for i, j in steps
    ]
    one, other = (np.concatenate(each) for each in zip(*pairs, strict=True))
    links = coo_matrix((-np.ones(len(one)), (one, other)), (side**2, side**2)).tocsr()
    links = links + links.T
    return links - identity(side**2).multiply(links.sum(1).ravel()) + 0.01 * identity(side**2)


def with_camera(normal, channels=3, numbers=8):
    """The same of each channel of colours, with numbers of the camera that took all photographs."""
    count = channels * normal.shape[0]
    of_camera = np.full((count, numbers), 1e-6)
    return bmat([[kron(normal, identity(channels)), of_camera], [of_camera.T, identity(numbers)]])


def test_the_unknowns_are_found_also_of_several_right_sides():
    normal, side = with_camera(lattice(12)), np.random.default_rng(0).normal(size=(440, 3))
    assert np.abs(normal @ solved(normal, side, 8) - side).max() < 1e-10
    assert solved(normal, side[:, 0], 8) == pytest.approx(solved(normal, side, 8)[:, 0])


def test_what_all_photographs_share_does_not_fill_the_factors(monkeypatch):
    """Light of 4,000 photographs took 10 s a round, and 30 times as long as that of 1,000."""
    filled = []
    whole = normal_equations.factorised
    monkeypatch.setattr(normal_equations, "factorised", lambda matrix: filled.append(whole(matrix)) or filled[-1])
    normal = with_camera(lattice(30))
    solved(normal, np.ones(normal.shape[0]), 8)
    assert filled[0].nnz < 0.9 * splu(normal.tocsc()).nnz and filled[0].nnz < 0.3 * whole(normal).nnz
