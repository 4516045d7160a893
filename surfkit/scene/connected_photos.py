"""Photographs that sparse points connect, and warnings about those that none does."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import islice

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from surfkit.core.check import few

BATCH_TRACKS = 20_000
"""Points between two checks whether all photographs are connected."""
LISTED_GROUPS = 4
"""Smaller groups that are listed, each with its size."""


def connect_groups(count: int, tracks: Iterable[Sequence[int]]) -> list[np.ndarray]:
    """Positions of the photographs of each group that points connect, the largest group first.

    Photographs without a point are in none. No more tracks are taken than connect all photographs, so that those of a
    whole scene, in random order, cost little.

    Args:
        count: Of photographs.
        tracks: For each point, positions of the photographs that show it.
    """
    labels, shown, tracks = np.arange(count), np.zeros(count, bool), iter(tracks)
    while (labels != labels[:1]).any() and (batch := list(islice(tracks, BATCH_TRACKS))):
        each = np.concatenate([np.asarray(track, np.int64) for track in batch])
        first = np.repeat([track[0] if len(track) else 0 for track in batch], [len(track) for track in batch])
        links = coo_matrix((np.ones(len(each), bool), (labels[first], labels[each])), (count, count))
        labels = connected_components(links, directed=False)[1][labels]
        shown[each] = True
    at = np.flatnonzero(shown)
    at = at[np.argsort(labels[at], kind="stable")]
    groups = np.split(at, np.flatnonzero(np.diff(labels[at])) + 1)
    return sorted(filter(len, groups), key=len, reverse=True)


def groups_warning(groups: Sequence[Sequence[str]]) -> str | None:
    """A warning about photographs that fall into several groups; None where there is one, or nothing is known.

    Args:
        groups: Names of the photographs of each, the largest group first.
    """
    if len(groups) < 2:
        return None
    sizes = [f"{len(groups[0])}", *(f"{len(names)} ({names[0]!r} for one)" for names in groups[1 : 1 + LISTED_GROUPS])]
    if more := len(groups) - len(sizes):
        sizes.append(f"{more} more of up to {len(groups[len(sizes)])}")
    return (
        f"the photographs fall into {len(groups)} groups without common sparse points, of {', '.join(sizes[:-1])} and "
        f"{sizes[-1]}: nothing in them tells how the groups lie to one another; look at all cameras in a viewer, and "
        "where they do not fit, match photographs across the groups, or train on each group by itself"
    )


def untied_warning(untied: Sequence[str]) -> str | None:
    """A warning about photographs to train on that show no sparse point; None where there are none.

    Args:
        untied: Their names.
    """
    if not untied:
        return None
    one = len(untied) == 1
    return (
        f"{len(untied)} photograph{'' if one else 's'} to train on show{'s' if one else ''} no sparse point, "
        f"{few(untied)}: nothing in the model confirms where they were taken, and stereo makes no depth maps of them, "
        "but what they show becomes surface all the same; match them again, or delete from the model what is of no use"
    )
