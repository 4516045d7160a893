"""Levels of detail along a path of the camera."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from statistics import median

from surfkit.compress.levels.lod_tree import LodTree
from surfkit.raster.api import Maps
from surfkit.raster.base import Rasterizer
from surfkit.scene.scene import View


@dataclass(frozen=True)
class DrawnLevels:
    """Draws what each view needs of the levels, and notes what that takes.

    Attributes:
        tree: The levels.
        draws: The rasterizer of their primitive.
        pixels: What `LodTree.seen` allows.
        geometry: Whether depths and normals are wanted.
        points: Splats of each view so far.
        seconds: For choosing and drawing them, of each view.
    """

    tree: LodTree
    draws: Rasterizer
    pixels: float
    geometry: bool
    points: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def __call__(self, view: View) -> Maps:
        """The maps of a view."""
        began = time.perf_counter()
        splats = self.tree.seen(view.camera, self.pixels)
        maps = self.draws.render(splats, view.camera, self.tree.levels[0].near, self.geometry, False).maps
        maps.need("color").cpu()  # a GPU may not have begun
        self.points.append(len(splats))
        self.seconds.append(time.perf_counter() - began)
        return maps

    def rows(self) -> list[tuple[str, str]]:
        """What to print; nothing where all frames were there already."""
        if not self.points:
            return []
        mean, most = sum(self.points) / len(self.points), max(self.points)
        splats = f"{mean:,.0f} of {len(self.tree.levels[0]):,} in a mean frame, {most:,} at most, {self.pixels:g} px"
        return [("splats", splats), ("a frame", f"{1e3 * median(self.seconds):.1f} ms, the median")]
