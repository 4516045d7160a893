"""An orthophoto from the photographs: the mesh with the texture that they give it, seen from above."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.apps.maps.bins import corners_of, sort_faces
from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.zbuffer import NO_TRIANGLE, ZBuffer, barycentric
from surfkit.apps.texture.prefetch_photos import by_photograph
from surfkit.apps.texture.seam_levelling import levelled
from surfkit.apps.texture.texture_export import TexturedMesh
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.scene.radiometry import exposed
from surfkit.scene.scene import Frame

MAX_HEIGHT_OFFSET_CELLS = 3.0
"""Cells of height by which the textured mesh, which is simplified, may differ from the surface model, to be what is
seen there."""
BATCH_CELLS = 1 << 20
"""Cells whose colour is computed at once."""


class OrthophotoColors:
    """Colours of cells that photographs show.

    Args:
        made: The textured mesh.
        frame: Of the data set.
        sheet: The map.
        side: Of a tile, cells.
    """

    def __init__(self, made: TexturedMesh, frame: Frame, sheet: GeoTiffSettings, side: int) -> None:
        self.paint = made.paint
        mesh = made.paint.mesh
        surface = SurfaceFile(sheet.out / "textured", frame.to_input(mesh.vertices), mesh.faces)
        self.bins = sort_faces(surface, sheet.grid, side, sheet.folder / "faces-textured")

    def over(self, tile: int, buffer: ZBuffer, image: np.ndarray) -> int:
        """Replace the colours of the cells of a tile that a photograph shows, and return how many these are.

        Args:
            tile: Its number.
            buffer: The surface model of the tile.
            image: (4, H, W) uint8 colours of the mesh there.
        """
        ours = ZBuffer(buffer.window)
        for numbers in self.bins.of(tile):
            ours.draw(corners_of(self.bins.surface, self.bins.grid, numbers), numbers)
        with np.errstate(invalid="ignore"):
            near = np.abs(ours.height - buffer.height) <= MAX_HEIGHT_OFFSET_CELLS * self.bins.grid.gsd
        cells = np.flatnonzero(near & (ours.face != NO_TRIANGLE) & (buffer.face != NO_TRIANGLE))
        face = ours.face.reshape(-1)[cells]
        parts = by_photograph(self.paint.atlas.view[face])
        self.paint.photos.expect([number for number, _ in parts])
        for number, some in parts:
            for at in range(0, len(some), BATCH_CELLS):
                rows = some[at : at + BATCH_CELLS]
                image.reshape(4, -1)[:3, cells[rows]] = self._colors(number, buffer, cells[rows], face[rows]).T
        return sum(len(some) for _, some in parts)

    def _colors(self, number: int, buffer: ZBuffer, cells: np.ndarray, face: np.ndarray) -> np.ndarray:
        """(n, 3) uint8 colours of cells in a photograph, between its pixels."""
        window, paint = buffer.window, self.paint
        row, column = np.divmod(cells, window.width)
        used, owner = np.unique(face, return_inverse=True)
        corners = corners_of(self.bins.surface, self.bins.grid, used)
        inside, second, third = barycentric(corners, owner, column + window.left + 0.5, row + window.top + 0.5)
        shares = np.full((len(cells), 3), 1 / 3)  # a triangle that is seen edge on
        shares[inside] = np.stack([1 - second - third, second, third], axis=1)
        places = (paint.mesh.vertices[paint.mesh.faces[face]].astype(np.float64) * shares[:, :, None]).sum(1)
        x, y, _ = paint.photos.views[number].camera.project(torch.from_numpy(places)).numpy().T
        added = (paint.levels.value[paint.levels.corner[face]] * shares[:, :, None]).sum(1)
        gain = paint.light.gains_at(number, paint.photos.views[number].camera, x, y)
        return levelled(exposed(between(paint.photos(number), x, y) / 255, gain), added)


def between(photo: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, 3) colours of a (3, H, W) photograph at places in pixels, between the four centres around each."""
    height, width = photo.shape[1:]
    left, top = np.floor(x - 0.5).astype(np.int64), np.floor(y - 0.5).astype(np.int64)
    p, q = (x - 0.5 - left)[:, None], (y - 0.5 - top)[:, None]

    def at(i: int, j: int) -> np.ndarray:
        return photo[:, (top + i).clip(0, height - 1), (left + j).clip(0, width - 1)].T

    return (1 - q) * ((1 - p) * at(0, 0) + p * at(0, 1)) + q * ((1 - p) * at(1, 0) + p * at(1, 1))
