"""The Gaussians with the nearest centres: a table that is made anew every so often while positions change."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from surfkit.plugin import RegularizerInput

AT, PLACES = "sugar/at", ("sugar/x", "sugar/y", "sugar/z")
"""Columns that are kept with the points: the step of the last refresh, and where the points were then."""

_TABLES = WeakTensorKeyDictionary()
"""By the column AT of a set of points, its table, which follows from the columns PLACES: nothing of it is lost."""


def nearest(centres: Tensor, count: int, places: Tensor | None = None) -> Tensor:
    """(P, K) int64 rows of the K nearest centres to each place, the nearest first.

    Args:
        centres: (N, 3).
        count: K; N where there are fewer.
        places: (P, 3); the centres themselves if None, which are then among their own nearest.
    """
    from scipy.spatial import cKDTree

    known = centres.detach().double().cpu().numpy()
    wanted = known if places is None else places.detach().double().cpu().numpy()
    tree = cKDTree(known)
    rows = tree.query(wanted, k=range(1, min(count, len(known)) + 1), workers=torch.get_num_threads())[1]
    return torch.from_numpy(rows).to(torch.int64).to(centres.device)


def remembered(means: Tensor, given: RegularizerInput, count: int, every: int) -> Tensor:
    """(N, K) the K nearest of each point as they were at the last refresh.

    A refresh is due every so many steps, and when there are new points. Points that are dropped leave the table.

    Args:
        means: (N, 3) positions now.
        given: The step, and the columns that are kept with the points.
        count: K.
        every: Steps between refreshes.
    """
    at, places = given.stat(AT), [given.stat(name) for name in PLACES]
    if float(at.min()) <= 0 or given.index - float(at.max()) >= every:
        at.fill_(given.index)
        for column, values in zip(places, means.detach().unbind(1), strict=True):
            column.copy_(values)
        _TABLES.pop(at, None)
    tables = _TABLES.setdefault(at, {})
    if count not in tables:
        tables[count] = nearest(torch.stack(places, 1), count)
    return tables[count]
