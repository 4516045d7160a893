"""The minimum cut against the maximum flow of scipy."""

import numpy as np
import pytest
from needs import needs_native
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import maximum_flow

from surfkit.mesh.delaunay import tetrahedralised
from surfkit.raster.native import module

pytestmark = needs_native


@pytest.mark.parametrize("seed", range(6))
def test_the_flow_and_the_cost_of_the_cut_are_those_of_scipy(seed):
    random = np.random.default_rng(seed)
    tets = tetrahedralised(random.random((40 + 60 * seed, 3)))
    neighbours, count = tets.neighbours, len(tets.neighbours)
    rows, corner = np.nonzero(neighbours >= 0)
    ends = neighbours[rows, corner]
    pair = np.zeros((count, 4), np.int32)
    drawn = random.integers(0, 30, (count, count), np.int32)
    pair[rows, corner] = drawn[np.minimum(rows, ends), np.maximum(rows, ends)]
    bias = random.integers(-40, 40, count).astype(np.int64)
    side = np.empty(count, np.uint8)
    flow = module().minimum_cut(neighbours, pair, bias, side)
    nodes = np.arange(count)
    starts = np.concatenate([rows, np.full(count, count), nodes])
    stops = np.concatenate([ends, nodes, np.full(count, count + 1)])
    room = np.concatenate([pair[rows, corner], np.maximum(bias, 0), np.maximum(-bias, 0)]).astype(np.int32)
    graph = coo_matrix((room, (starts, stops)), shape=(count + 2,) * 2).tocsr()
    assert flow == maximum_flow(graph, count, count + 1).flow_value
    full = side == 1
    cost = pair[rows, corner][~full[rows] & full[ends]].sum()
    cost += np.maximum(bias, 0)[full].sum() + np.maximum(-bias, 0)[~full].sum()
    assert cost == flow and 0 < full.sum() < count


def test_where_nothing_is_known_all_is_empty():
    tets = tetrahedralised(np.random.default_rng(0).random((20, 3)))
    count = len(tets.corners)
    side = np.full(count, 7, np.uint8)
    pair, bias = np.ones((count, 4), np.int32), np.zeros(count, np.int64)
    assert module().minimum_cut(tets.neighbours, pair, bias, side) == 0 and not side.any()
