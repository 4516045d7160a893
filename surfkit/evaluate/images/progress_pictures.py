"""How a run comes along: pictures and PSNR of a few held-out views, every so often."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import FileWritten, Measured, PhotoSkipped, emit
from surfkit.evaluate.images.comparison_pictures import panel, picture_path, write_picture
from surfkit.evaluate.images.measure_images import Draw
from surfkit.raster.psnr import psnr
from surfkit.scene.photos import photo_cache
from surfkit.scene.scene import View

MAX_PROGRESS_VIEWS = 3
"""Views that are looked at."""


class ProgressPictures:
    """Draws up to three views, evenly chosen, beside their photographs.

    Args:
        folder: Gets a folder for each time, named after the step.
        views: Held-out ones.
    """

    def __init__(self, folder: Path, views: Sequence[View]) -> None:
        count = min(MAX_PROGRESS_VIEWS, len(views))
        self.folder = folder
        self.views = [views[i * len(views) // count] for i in range(count)]
        self.photos: Sequence[Tensor] | None = None

    def look(self, index: int, draw: Draw) -> None:
        """Draw after a step."""
        if self.photos is None:
            self.photos = photo_cache(self.views)
        found = {}
        for at, view in enumerate(self.views):
            try:
                photo = self.photos[at]
            except BadInput as error:
                emit(PhotoSkipped(view.name, str(error)))
                continue
            maps = draw(view)
            found[view.name] = psnr(maps.need("color"), photo.to(maps.need("color")) / 255)
            path = picture_path(self.folder / f"{index:06}", view.name)
            write_picture(path, panel(photo, maps))
            emit(FileWritten(path, "picture"))
        if found:
            emit(Measured(index, found))
