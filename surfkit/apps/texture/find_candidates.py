"""All photographs are looked at, one after the other, for what each shows of a surface."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from surfkit.apps.texture.candidates import Candidates
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos
from surfkit.apps.texture.texture_cache import TextureCache
from surfkit.apps.texture.triangle_visibility import TriangleVisibility
from surfkit.core.check import BadInput
from surfkit.core.events import PhotoSkipped, Progress, emit
from surfkit.scene.one_light import OneLight

LOOKED_FOLDER, PAUSE_S, SAVE_PAUSE_FACTOR = "looked", 20.0, 30.0
"""What was seen in the photographs so far is kept every `PAUSE_S` seconds, or `SAVE_PAUSE_FACTOR` times as long as that
takes."""
Show = Callable[[int, np.ndarray, "np.ndarray | None"], "TriangleVisibility | None"]
"""What a photograph shows, from its number, its (3, H, W) picture and its mask; None for nothing."""


def candidates_of(
    count: int,
    photos: PrefetchedPhotos,
    show: Show,
    kept: TextureCache = TextureCache(),
    light: OneLight | None = None,
) -> tuple[Candidates, OneLight, int]:
    """What can be chosen from, the light of the photographs, and how many photographs of a place were refused.

    Args:
        count: Places: triangles of a mesh, or cells of a map.
        photos: The photographs; those that cannot be read are left out, and told.
        show: What one shows.
        kept: Where what was seen is kept now and then; the caller forgets it.
        light: Of the photographs, where it is known.
    """
    found, start = Candidates(count), 0
    if (before := kept.read(LOOKED_FOLDER)) is not None:
        start = int(before.pop("count"))
        vars(found).update(before)
    photos.expect(range(start, len(photos.views)))
    saved, spent = time.perf_counter(), 0.0
    for number in range(start, len(photos.views)):
        view = photos.views[number]
        try:
            picture, keep = photos(number), photos.keep(number)
        except BadInput as error:
            emit(PhotoSkipped(view.name, str(error)))
            continue
        if (shown := show(number, picture, keep)) is not None:
            found.offer(number, shown)
        now = time.perf_counter()
        if now - saved > max(PAUSE_S, SAVE_PAUSE_FACTOR * spent):
            kept.write(LOOKED_FOLDER, {**vars(found), "count": np.array(number + 1)})
            saved = time.perf_counter()
            spent = saved - now
        emit(Progress("looking at photographs", number + 1, len(photos.views)))
    light = light or OneLight.of(photos.views, found.shared(len(photos.views)))
    found.shun_clipped()
    return found, light, found.refuse_outliers(light)
