"""The photographs of a data set, one after the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surfkit.apps.texture.candidates import NO_PHOTO
from surfkit.io.datasets.masks import mask_cache
from surfkit.scene.photos import photo_cache
from surfkit.scene.scene import View


def by_photograph(view: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Each photograph of (n,) numbers, and the rows that have it, rising; those of NONE are left out."""
    order = np.argsort(view, kind="stable")
    order = order[view[order] != NO_PHOTO]
    numbers, starts = np.unique(view[order], return_index=True)
    parts = np.split(order, starts[1:])  # one, and not none, of no rows
    return list(zip(numbers.tolist(), parts[: len(numbers)], strict=True))


class PrefetchedPhotos:
    """Photographs of views by number, read ahead in the order in which they are expected."""

    def __init__(self, views: Sequence[View], budget_bytes: int) -> None:
        self.views = views
        self.cache = photo_cache(views, 3 * budget_bytes // 4)
        self.masks = mask_cache(views, budget_bytes // 4)

    def expect(self, numbers: Sequence[int] | np.ndarray) -> None:
        """Read in this order from now on."""
        self.cache.expect([int(number) for number in numbers])

    def __call__(self, number: int) -> np.ndarray:
        """(3, H, W) uint8."""
        return self.cache[number].numpy()

    def close(self) -> None:
        """Forget all of them; none can be asked for afterwards."""
        for cache in (self.cache, self.masks):
            if cache is not None:
                cache.close()
                cache.resize(0)

    def keep(self, number: int) -> np.ndarray | None:
        """(H, W) bool, or None for all of it."""
        if self.masks is None:
            return None
        found = self.masks[number]
        return None if found is None else found.numpy()
