"""What training looks at, kept in memory within a number of bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.memory import give_back
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import DepthAlignment, Priors, prior_bytes, read_priors
from surfkit.io.datasets.masks import mask_cache, mask_sizes
from surfkit.losses.base import Loss
from surfkit.raster.nvrtc.gpu_memory import free_gpu_bytes
from surfkit.scene.align import SCALE_BAND
from surfkit.scene.available_memory import cache_bytes
from surfkit.scene.cache import Cache, share
from surfkit.scene.decoded_photos import DecodedPhotoCache
from surfkit.scene.photos import photo_cache
from surfkit.scene.scene import Scene
from surfkit.train.points_on import PointsOn

CACHE_REDUCTION = 4
"""The caches keep this share of what they held when memory ran short, the first time; nothing the second time."""

GPU_SHARE = 0.25
"""Of the free memory of a GPU that views take by default: the points are yet to grow."""


@dataclass(frozen=True)
class CacheSettings:
    """Where photographs, masks and depth priors are kept at hand, and points; the result does not depend on it.

    Attributes:
        cache: Memory for them, such as "4GB"; "auto" takes half of what is free.
        copies: Whether photographs that do not fit are also kept on disk as they are used, decoded and reduced.
        gpu: Memory of the GPU for the same, where there is one, likewise; "auto" takes a quarter of what is free on it
            when a stage begins.
        maps: Disk, in the user's cache, for depth maps that runs make whose data sets have none, such as "20GB"; None
            makes none, which does change the result of recipes that want some.
        points: Where points are kept.
    """

    cache: str = "auto"
    copies: bool = False
    maps: str | None = "20GB"
    gpu: str = "auto"
    points: PointsOn = PointsOn()

    def bytes(self) -> int:
        """The memory that may be taken now."""
        cache_bytes(self.gpu, "--gpu-cache", lambda: 0)
        return cache_bytes(self.cache)

    def maps_bytes(self) -> int:
        """The disk that depth maps in the user's cache may take."""
        if (self.maps or "").strip().lower() == "auto":
            raise BadInput("--prepare-cache auto: give a size such as 20GB")
        return 0 if self.maps is None else cache_bytes(self.maps, "--prepare-cache", other="")


@dataclass(frozen=True)
class TrainingData:
    """What training looks at, by position of the view.

    Attributes:
        photos: (3, H, W) uint8.
        masks: (H, W) bool or None.
        priors: Estimated depths, if a loss of the recipe needs them and the data set has any.
        gpu: As in `CacheSettings`.
    """

    photos: Cache[Tensor]
    masks: Cache[Tensor | None] | None = None
    priors: Priors | None = None
    gpu: str = "auto"

    def gpu_bytes(self) -> int:
        """Of the GPU, that views may take."""
        return cache_bytes(self.gpu, "--gpu-cache", lambda: int(GPU_SHARE * free_gpu_bytes()))

    def caches(self) -> Iterator[Cache[Any]]:
        """Those that there are."""
        return filter(None, (self.photos, self.masks, self.priors))

    def bytes(self) -> dict[str, int]:
        """What each of them keeps or reads now."""
        named = {"photographs": self.photos, "masks": self.masks, "priors": self.priors}
        return {name: cache.bytes for name, cache in named.items() if cache is not None}

    def expect(self, coming: Sequence[int]) -> None:
        """Read in this order from now on."""
        for cache in self.caches():
            cache.expect(coming)

    def lower(self) -> tuple[int, int] | None:
        """Keep much less from now on: bytes kept before and after; None if there is nothing left to lower."""
        before = sum(cache.bytes for cache in self.caches())
        if not any(cache.budget for cache in self.caches()):
            return None
        for cache in self.caches():
            kept = cache.bytes // CACHE_REDUCTION
            cache.resize(kept if kept > max(cache.sizes, default=0) and not cache.lowered else 0)
        give_back()
        return before, sum(cache.bytes for cache in self.caches())


def needs_priors(losses: Mapping[str, Loss]) -> bool:
    """Whether any loss looks at depth priors."""
    return any(loss.needs_prior for loss in losses.values())


def needs_normals(losses: Mapping[str, Loss]) -> bool:
    """Whether any loss looks at the normals of depth priors."""
    return any(loss.needs_prior and loss.needs_normals for loss in losses.values())


def scale_band(losses: Mapping[str, Loss]) -> tuple[float, float]:
    """The widest band of the scales of depth priors that any loss accepts; see `Loss.scale_band`."""
    bands = [loss.scale_band for loss in losses.values() if loss.needs_prior and loss.scale_band] or [SCALE_BAND]
    return min(low for low, _ in bands), max(high for _, high in bands)


def read_ahead(
    data: Data, scene: Scene, losses: Mapping[str, Loss], caches: CacheSettings, known: DepthAlignment | None = None
) -> TrainingData:
    """The photographs, masks and depth priors of the training views, as far as losses need them.

    `known`: how the depth priors are aligned, where that is known; see `read_priors`.
    """
    budget = caches.bytes()
    pixels = sum(view.camera.width * view.camera.height for view in scene.train)
    needed, normals = needs_priors(losses), needs_normals(losses)
    wanted = [3 * pixels, sum(mask_sizes(scene.train)), prior_bytes(normals) * pixels if needed else 0]
    for_photos, for_masks, for_priors = share(budget, wanted)
    priors = read_priors(data, scene, for_priors, known, normals) if needed else None
    is_short = for_photos is not None and 3 * pixels > for_photos
    copies = DecodedPhotoCache(data.path) if caches.copies and is_short else None
    photos, masks = photo_cache(scene.train, for_photos, copies), mask_cache(scene.train, for_masks)
    return TrainingData(photos, masks, priors, caches.gpu)
