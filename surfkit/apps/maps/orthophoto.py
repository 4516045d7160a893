"""A true orthophoto from photographs: each cell is where its surface is, no seam shows.

Regions of photographs (`photo_regions`) are made exact cell by cell: a photograph that does not show a cell well leaves
it to another one. Both sides of a cut line are blended in bands of frequency (Burt and Adelson, A Multiresolution
Spline with Application to Image Mosaics, ACM Transactions on Graphics, 1983): fine detail over a cell, light over many.
Each square of the map is made by itself, with a margin as wide as anything in it depends on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.map_grid import Window
from surfkit.apps.maps.photo_regions import PhotoRegions, find_regions
from surfkit.apps.maps.photo_sight import between, look
from surfkit.apps.maps.rasters import NODATA, Raster, window_of
from surfkit.apps.texture.candidates import NO_PHOTO
from surfkit.apps.texture.pieces import MeshClusters
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos
from surfkit.apps.texture.resolution import pixel_sizes
from surfkit.apps.texture.texture_cache import TextureCache
from surfkit.apps.texture.texture_mesh import MeshWithPhotos, local_mesh, reduced
from surfkit.core.events import Progress, Warned, emit
from surfkit.scene.scene import Frame

BANDS = 5
"""Bands of frequency; the coarsest changes over 2 ** BANDS cells."""
MARGIN = 4 << BANDS
"""Cells around a square that its blended colours depend on: bands reach so far on both ways, down and up."""
SIDE = 1024
"""Of a square, cells: a multiple of 2 ** BANDS, so that the bands of all squares have the same grid."""
REACH = 2 << BANDS
"""Cells beyond its region up to which a photograph is looked up for blending; bands hardly reach farther."""
FINE = 64
"""Steps of a colour of 8 bits in which is blended."""
WELL, ELSEWHERE, BADLY = 8.0, 4.0, 2.0
"""Ranks of photographs at a cell: it is of a region there or near and shows the cell well, it is another one that does,
it is of a region and shows the cell near an outline; 0 for the rest, such as one that was refused there. Added is its
share of the regions around, or how well it shows the block, from 0 to 1."""
MIN_PIECE_CELLS = 16
"""A piece of fewer cells of one photograph is left to that of the region, also near an outline."""


@dataclass(frozen=True)
class OrthophotoSource:
    """What an orthophoto is made from.

    Attributes:
        frame: Of the data set.
        heights: The surface model, a file.
        rest: Colours of the mesh, a file, for cells that no photograph shows.
        pieces: The mesh, local frame.
        photos: The photographs.
        regions: Which of them are where.
    """

    frame: Frame
    heights: Path
    rest: Path
    pieces: MeshClusters
    photos: PrefetchedPhotos
    regions: PhotoRegions


def mosaic(
    subject: MeshWithPhotos,
    sheet: GeoTiffSettings,
    heights: str,
    rest: Path,
    names: tuple[str, str],
    budget_bytes: int,
) -> dict[str, Any]:
    """Write the orthophoto of a mesh, and what photograph each cell is from; returns what maps.json says of them.

    Args:
        subject: The mesh and its photographs.
        sheet: Where.
        heights: File name of the surface model, which is finished.
        rest: The colours of the mesh, a raster.
        names: File names of the orthophoto, and of the numbers of photographs.
        budget_bytes: Memory for photographs.
    """
    surface, frame = subject.surface, subject.frame
    sizes = pixel_sizes(surface, subject.views, frame)
    photos = PrefetchedPhotos(reduced(subject.views, sizes, sheet.grid.gsd), budget_bytes)
    pieces, model = MeshClusters(local_mesh(surface, frame)), sheet.out / heights
    regions = find_regions(sheet.grid, frame, model, pieces, photos, TextureCache(sheet.folder))
    cells = draw_squares(OrthophotoSource(frame, model, rest, pieces, photos, regions), sheet, *names)
    if not cells:
        told = f"of {len(subject.views)} photographs, none shows any of it, outside of masks and with nothing in front"
        emit(Warned(f"{surface.path}: {told}: all of the orthophoto has the colours of the mesh"))
    named = {str(at + 1): {"name": subject.views[at].name, "cells": cells[at]} for at in sorted(cells)}
    return {"photographs": named}


def draw_squares(source: OrthophotoSource, sheet: GeoTiffSettings, colors: str, numbers: str) -> dict[int, int]:
    """Write the orthophoto, and a raster of the number of the photograph of each cell, counted from 1; 0 is none.

    Returns how many cells each photograph has, by its row in the views.

    Args:
        source: What it is made from.
        sheet: Where.
        colors: File name of the orthophoto.
        numbers: File name of the numbers.
    """
    cells: dict[int, int] = {}
    windows = list(sheet.grid.tiles(SIDE))
    with sheet.raster(colors, "colors") as photo, sheet.raster(numbers, "numbers") as labels:
        for done, window in enumerate(windows, 1):
            facts = labels.facts(window)
            if facts is None and (made := Square(source, sheet, window)).covered.any():
                facts = made.write(photo, labels)
            for number, count in () if facts is None else facts["cells"]:
                cells[number] = cells.get(number, 0) + count
            emit(Progress("drawing orthophoto", done, len(windows)))
    return cells


class Square:
    """A square of the map with its margin, while it is made.

    Attributes:
        wide: The window with its margin.
        covered: (H, W) bool where there is a surface; H and W with the margin.
        number: (H, W) int32 row of the photograph of each cell; NO_PHOTO for none.
        color: (H, W, 3) int16 its colours, in 1 / FINE, and those of the mesh elsewhere.
    """

    def __init__(self, source: OrthophotoSource, sheet: GeoTiffSettings, window: Window) -> None:
        self.source, self.sheet, self.window = source, sheet, window
        left, top = max(0, window.left - MARGIN), max(0, window.top - MARGIN)
        right = min(sheet.grid.width, window.left + window.width + MARGIN)
        bottom = min(sheet.grid.height, window.top + window.height + MARGIN)
        self.wide = Window(left, top, right - left, bottom - top)
        self.height = read_window(source.heights, self.wide)[0].astype(np.float64)
        self.covered = self.height != NODATA

    def write(self, photo: Raster, labels: Raster) -> dict[str, list[list[int]]]:
        """Make the square, keep it, and return what is counted of it."""
        self._look_up()
        top, left = self.window.top - self.wide.top, self.window.left - self.wide.left
        inner = np.s_[top : top + self.window.height, left : left + self.window.width]
        image = np.concatenate([self._blended(), np.where(self.covered, 255, 0).astype(np.uint8)[..., None]], axis=2)
        image[~self.covered] = 0
        photo.write(image[inner].transpose(2, 0, 1), self.window)
        number = self.number[inner]
        used, count = np.unique(number[number != NO_PHOTO], return_counts=True)
        facts = {"cells": np.stack([used, count], 1).tolist()}
        labels.write(number + 1, self.window, facts)  # last: the square is done
        return facts

    def _look_up(self) -> None:
        """Find the photograph and the colour of each cell, and the colours of others that it is blended with."""
        shape = self.covered.shape
        self.number, rank = np.full(shape, NO_PHOTO, np.int32), np.zeros(shape, np.float32)
        mesh = read_window(self.source.rest, self.wide)[:3].transpose(1, 2, 0)
        self.color = mesh.astype(np.int16) * FINE
        self.seen: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
        label, self.at = self._blocks()
        here = np.unique(label[label != NO_PHOTO]).tolist()
        reach = 2 * -(-REACH // self.source.regions.block) + 1
        view = self.source.regions.view[self.block_rows[:, None], self.block_columns]
        for photo in here:
            near = ndimage.maximum_filter(label == photo, reach)
            fits = (view == photo).any(-1) | (view != NO_PHOTO).all(-1)
            share = self._share(label == photo)
            ranks = [np.where(fits, each, np.float32(0))[self.at] + share for each in (WELL, BADLY)]
            self._offer(photo, near[self.at] & self.covered, ranks, rank)
        own, own_color = np.where(rank >= BADLY, self.number, NO_PHOTO), self.color.copy()
        poor = self.covered & (rank < WELL)
        around = 2 * -(-(1 << BANDS) // self.source.regions.block) + 1
        full = (view != NO_PHOTO).all(-1)
        for photo in np.unique(view[self.at][poor]).tolist():
            if photo != NO_PHOTO:
                slot = view == photo
                good = np.where(slot.any(-1), view.shape[-1] - slot.argmax(-1), 0).astype(np.float32)
                for axis in (0, 1):  # around, so that neighbours take the same one; sums of whole numbers are exact
                    good = ndimage.correlate1d(good, np.ones(around), axis)
                mean = (good / (view.shape[-1] * around**2))[self.at]
                there = poor & (slot.any(-1) | full)[self.at] & (mean > 0)
                self._offer(photo, there, [mean + np.float32(ELSEWHERE), mean], rank)
        crumbs = (own != self.number) & (own != NO_PHOTO) & small_pieces(self.number, poor)
        self.number[crumbs], self.color[crumbs] = own[crumbs], own_color[crumbs]

    def _blocks(self) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """The labels of the blocks on the square and around it, and the row and column in them of each of its cells."""
        regions, wide = self.source.regions, self.wide
        around = -(-REACH // regions.block) + 1
        rows = np.arange(wide.top // regions.block - around, -(-(wide.top + wide.height) // regions.block) + around)
        columns = np.arange(wide.left // regions.block - around, -(-(wide.left + wide.width) // regions.block) + around)
        self.block_rows = rows.clip(0, regions.label.shape[0] - 1)
        self.block_columns = columns.clip(0, regions.label.shape[1] - 1)
        row = (np.arange(wide.height) + wide.top) // regions.block - rows[0]
        column = (np.arange(wide.width) + wide.left) // regions.block - columns[0]
        self.first = rows[0], columns[0]
        return regions.label[self.block_rows[:, None], self.block_columns], np.ix_(row, column)

    def _share(self, of: np.ndarray) -> np.ndarray:
        """(H, W) float32 of a mask of blocks, between their centres: so cut lines are smooth."""
        block, wide = self.source.regions.block, self.wide
        row = (np.arange(wide.height) + wide.top + 0.5) / block - 0.5 - self.first[0]
        column = (np.arange(wide.width) + wide.left + 0.5) / block - 0.5 - self.first[1]
        i, j = np.floor(row).astype(int), np.floor(column).astype(int)
        p, q = (row - i).astype(np.float32)[:, None], (column - j).astype(np.float32)
        value = of.astype(np.float32)
        upper, lower = ((1 - q) * value[np.ix_(each, j)] + q * value[np.ix_(each, j + 1)] for each in (i, i + 1))
        return (1 - p) * upper + p * lower

    def _offer(self, photo: int, there: np.ndarray, ranks: list[np.ndarray], rank: np.ndarray) -> None:
        """Look cells up in a photograph, and take their colours where that is better than what is known.

        Args:
            photo: Row of the photograph.
            there: (H, W) bool which cells.
            ranks: (H, W) float32 how good that is where the photograph shows the cell well, and where it does not.
            rank: (H, W) float32 how good what is known is.
        """
        source, grid = self.source, self.sheet.grid
        cells = np.flatnonzero(there)
        row, column = np.divmod(cells, self.wide.width)
        places = np.stack([
            column + (self.wide.left + 0.5), row + (self.wide.top + 0.5), self.height.reshape(-1)[cells]
        ], axis=1)  # fmt: skip
        camera = source.photos.views[photo].camera
        sight = look(source.frame.to_local(grid.from_cells(places)), camera, source.pieces, source.photos.keep(photo))
        if not len(sight.rows):
            return
        shown = between(source.photos(photo), sight.x, sight.y) / 255
        color = source.regions.light.even(shown, photo, camera, sight.x, sight.y)
        color = np.rint(255 * FINE * color).astype(np.int16)
        cells = cells[sight.rows]
        found = np.where(sight.clear, *(each.reshape(-1)[cells] for each in ranks))
        better = found > rank.reshape(-1)[cells]
        rank.reshape(-1)[cells[better]] = found[better]
        self.number.reshape(-1)[cells[better]] = photo
        self.color.reshape(-1, 3)[cells[better]] = color[better]
        shown = sight.clear | better
        self.seen.setdefault(photo, []).append((cells[shown], color[shown]))

    def _blended(self) -> np.ndarray:
        """(H, W, 3) uint8 colours without seams.

        Where a photograph does not show a cell, the one that was chosen there stands in for it.
        """
        from cv2 import CV_32F, detail

        height, width = self.number.shape
        used = np.unique(self.number)
        result = self.color
        if len(used) > 1:
            blender = detail.MultiBandBlender(0, BANDS, CV_32F)
            blender.prepare((0, 0, width, height))
            for photo in used.tolist():
                mask = self.number == photo
                row, column = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
                top, left = (max(0, (each[0] - MARGIN) >> BANDS << BANDS) for each in (row, column))
                part = np.s_[top : row[-1] + 1 + MARGIN, left : column[-1] + 1 + MARGIN]
                image = self.color.copy()
                for cells, color in self.seen.get(photo, ()):
                    image.reshape(-1, 3)[cells] = color
                blender.feed(
                    np.ascontiguousarray(image[part]), mask[part].astype(np.uint8) * 255, (int(left), int(top))
                )
            result, _ = blender.blend(None, None)  # type: ignore[call-overload]  # both are made by OpenCV
        return np.rint(result / FINE).clip(0, 255).astype(np.uint8)


def small_pieces(number: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(H, W) bool cells of pieces of fewer than `MIN_PIECE_CELLS` cells with the same number; looked for at some."""
    found = np.zeros(number.shape, bool)
    for each in np.unique(number[where]).tolist():
        piece, count = ndimage.label(number == each)
        found |= (np.bincount(piece.reshape(-1), minlength=count + 1) < MIN_PIECE_CELLS)[piece] & (piece > 0)
    return found & where


def read_window(file: Path, window: Window) -> np.ndarray:
    """(C, H, W) a part of a raster."""
    import rasterio

    with rasterio.open(file) as raster:
        return raster.read(window=window_of(window))
