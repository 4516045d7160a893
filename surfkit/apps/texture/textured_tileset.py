"""A textured mesh as 3D Tiles 1.1: what viewers of the globe stream.

Source: OGC 22-025r4, 3D Tiles 1.1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.apps.texture.fill import PaintInput, Pictures
from surfkit.apps.texture.obj_glb import AtlasPageMesh, write_textured_glb
from surfkit.apps.texture.regions import Region
from surfkit.core.codec import write_json
from surfkit.io.splats.gltf_reader import UPS
from surfkit.io.splats.tileset import INDEX, box_json, ground_of, tileset
from surfkit.scene.scene import Frame

REFINE_ERROR_PX = 16.0
"""Geometric errors of as many pixels or more make viewers refine, by default: where a texel takes a pixel, or the
surface is off by one."""


class TilesetWriter:
    """A tileset that is being written: a GLB file for each region of each level of detail, then tileset.json.

    Args:
        folder: For the tileset, new.
        frame: Of the data set.
        up: (3, 3) from the frame of the input to z up, where it is not placed on Earth.
        pictures: Of the pages.
        geoid: What heights are above, see `ground_of`.
    """

    def __init__(
        self, folder: Path, frame: Frame, up: np.ndarray, pictures: Pictures, geoid: str | None = None
    ) -> None:
        self.folder, self.frame, self.pictures = folder, frame, pictures
        self.ground = ground_of(Path(folder.name), frame, up, geoid=geoid)  # not the name that it has until it is whole
        self.written: dict[int, tuple[dict[str, Any], np.ndarray]] = {}  # by identity of the region
        self.count, self.error = 0, 0.0  # of a level above is no less than that of one below

    def write(
        self,
        regions: Sequence[Region],
        paint: PaintInput,
        parts: Sequence[AtlasPageMesh],
        pages: Sequence[Path],
        error: float,
    ) -> None:
        """Write the tiles of a level, the finest first; regions that have a tile already keep it.

        Args:
            regions: By the number that they have in the atlas.
            paint: The textured mesh of the level.
            parts: The triangles of each page.
            pages: The file of each page.
            error: Side of a texel, or how far the surface lies from that of the finest level if that is more, units of
                the input; 0 for the finest level.
        """

        self.error = max(self.error, error)

        def place(local: np.ndarray) -> np.ndarray:
            return self.ground.metres(self.frame.to_input(local))

        for number, region in enumerate(regions):
            mine = [at for at, page in enumerate(paint.atlas.pages) if page.tile == number]
            if id(region) in self.written or not mine:
                continue
            name = f"tiles/{self.count}.glb"
            self.count += 1
            files = [parts[at] for at in mine], [pages[at] for at in mine]
            corners = write_textured_glb(self.folder / name, paint.mesh, *files, self.pictures, place, UPS["z"])
            found = {"geometricError": REFINE_ERROR_PX * self.error * self.ground.unit, "content": {"uri": name}}
            self.written[id(region)] = found, corners

    def finish(self, region: Region) -> None:
        """Write tileset.json for the region of all."""
        root, _ = self._tile(region)
        write_json(self.folder / INDEX, tileset(root, self.ground.matrix, self.ground.notes))

    def _tile(self, region: Region) -> tuple[dict[str, Any], np.ndarray]:
        """The JSON of a tile and of all below it, and the (2, 3) corners of its box."""
        found, corners = self.written[id(region)]
        below = [self._tile(part) for part in self._next(region)]
        corners = np.stack([np.min([corners[0], *(box[0] for _, box in below)], axis=0),
                            np.max([corners[1], *(box[1] for _, box in below)], axis=0)])  # fmt: skip
        found = {"boundingVolume": box_json(corners), **found}
        return found | ({"children": [child for child, _ in below]} if below else {}), corners

    def _next(self, region: Region) -> Iterator[Region]:
        """The nearest regions within a region that have tiles."""
        for part in region.below:
            if id(part) in self.written:
                yield part
            else:
                yield from self._next(part)
