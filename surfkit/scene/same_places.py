"""Points in the same place."""

from __future__ import annotations

import numpy as np

from surfkit.scene.set_membership import is_among

HASH = np.uint64(0x9E3779B97F4A7C15)
"""An odd number whose product scatters the bits of a coordinate."""


def first_in_place(places: np.ndarray) -> np.ndarray | None:
    """(V,) int32 row of the first point in the place of each; None where no two share a place.

    Args:
        places: (V, 3) float32 or float64; places are the same if all their bits are, but for the sign of zero.
    """
    places = np.ascontiguousarray(places + places.dtype.type(0))  # -0 becomes 0
    # Only those whose hashes are not their own are compared: sorting all places takes twice as long.
    bits = places.view(np.dtype(f"u{places.dtype.itemsize}"))
    x, y, z = (bits[:, axis].astype(np.uint64) for axis in range(3))
    hashes = (x * HASH ^ y) * HASH ^ z
    ranked = np.sort(hashes)
    alike = np.flatnonzero(is_among(hashes, np.unique(ranked[1:][ranked[1:] == ranked[:-1]])))
    rows = places[alike].view(np.dtype((np.void, 3 * places.dtype.itemsize)))[:, 0]
    _, first, at = np.unique(rows, return_index=True, return_inverse=True)
    if len(first) == len(alike):
        return None
    stands_for = np.arange(len(places), dtype=np.int32)
    stands_for[alike] = alike[first][at]
    return stands_for
