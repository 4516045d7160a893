"""Labels of the nodes of a graph by minimum cuts: alpha expansion.

Boykov, Veksler and Zabih, Fast Approximate Energy Minimization via Graph Cuts (PAMI 2001): one label after the other is
offered to all nodes, and a minimum cut tells which of them take it so that the energy is least.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

MAX_CAPACITY = 1 << 22
"""Of an edge of a graph: capacities are whole numbers of 32 bits, as their sums at a node are."""
MAX_SWEEPS = 4
"""Times that all labels are offered, at most."""


class LabelEnergy(Protocol):
    """What labels cost.

    Attributes:
        edges: (E, 2) rows of the two nodes of each edge, each pair once.
    """

    edges: np.ndarray

    def nodes_of(self, label: int) -> np.ndarray:
        """(n,) rows of the nodes that can have a label, rising."""

    def node_costs(self, nodes: np.ndarray, label: np.ndarray) -> np.ndarray:
        """(n,) costs of nodes with a label each, 0 or more."""

    def edge_costs(self, edges: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """(m,) costs, 0 or more, of rows of `edges` whose first node has the label `one`, and its second `other`; 0
        where both are equal."""


def expanded(energy: LabelEnergy, label: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(N,) labels of a low energy: no offer of one label to all nodes lowers it, or `MAX_SWEEPS` are done.

    Args:
        energy: What labels cost.
        label: (N,) to begin with.
        labels: Those that are offered, in this order.
    """
    found = label.copy()
    for _ in range(MAX_SWEEPS):
        if not any([_expand(energy, found, each) for each in labels.tolist()]):
            break
    return found


def _expand(energy: LabelEnergy, label: np.ndarray, alpha: int) -> bool:
    """Let nodes take one label, in place, where that lowers the energy; whether any did."""
    nodes = energy.nodes_of(alpha)
    nodes = nodes[label[nodes] != alpha]
    if not len(nodes):
        return False
    number = np.full(len(label), -1, np.int64)
    number[nodes] = np.arange(len(nodes))
    ends = energy.edges
    inside = number[ends] >= 0
    touched = np.flatnonzero(inside.any(1))
    inside, before = inside[touched], label[ends[touched]]
    new = np.full(len(touched), alpha)
    # what an edge costs when neither of its ends changes, the second, the first, both: the last is nothing
    stay = energy.edge_costs(touched, before[:, 0], before[:, 1])
    second = energy.edge_costs(touched, before[:, 0], new)
    first = energy.edge_costs(touched, new, before[:, 1])
    cost = energy.node_costs(nodes, np.full(len(nodes), alpha)) - energy.node_costs(nodes, label[nodes])
    only_first, only_second, both = inside[:, 0] & ~inside[:, 1], inside[:, 1] & ~inside[:, 0], inside.all(1)
    at = number[ends[touched]]
    cost += np.bincount(at[only_first, 0], (first - stay)[only_first], len(nodes))
    cost += np.bincount(at[only_second, 1], (second - stay)[only_second], len(nodes))
    cost += np.bincount(at[both, 0], (first - stay)[both], len(nodes))
    cost -= np.bincount(at[both, 1], first[both], len(nodes))
    # where the triangle inequality does not hold, changing one end seems to cost nothing: still no worse than it was
    taken = _cut(cost, at[both], (first + second - stay)[both].clip(min=0))
    if not taken.any():
        return False
    after = label.copy()
    after[nodes[taken]] = alpha
    now = energy.edge_costs(touched, *after[ends[touched]].T).sum() + energy.node_costs(nodes, after[nodes]).sum()
    if now >= stay.sum() + energy.node_costs(nodes, label[nodes]).sum() - 1e-6:
        return False
    label[:] = after
    return True


def _cut(cost: np.ndarray, ends: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(n,) which nodes change, so that the sum of the costs of those that do, and of the weights of the edges whose
    second end does and the first does not, is least.

    Args:
        cost: (n,) of a change.
        ends: (m, 2) nodes of each edge.
        weight: (m,) 0 or more.
    """
    source, sink = len(cost), len(cost) + 1
    dear, cheap = np.flatnonzero(cost > 0), np.flatnonzero(cost < 0)
    tail = np.concatenate([ends[:, 0], np.full(len(dear), source), cheap])
    head = np.concatenate([ends[:, 1], dear, np.full(len(cheap), sink)])
    size = np.concatenate([weight, cost[dear], -cost[cheap]])
    most = float(size.max(initial=0))
    if not len(cheap) or most == 0:
        return np.zeros(len(cost), bool)
    whole = np.rint(size * (MAX_CAPACITY / most)).astype(np.int32)
    graph = csr_matrix((whole, (tail, head)), (sink + 1, sink + 1))
    left = graph - maximum_flow(graph, source, sink).flow
    left.eliminate_zeros()
    kept = breadth_first_order(left, source, return_predecessors=False)
    taken = np.ones(sink + 1, bool)
    taken[kept] = False
    return taken[:source]
