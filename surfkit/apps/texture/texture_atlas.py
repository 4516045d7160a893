"""Charts, connected triangles with the same photograph, and their places on the pages of an atlas.

A chart has the shape that it has in its photograph, so texels are pixels, and nothing is resampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from surfkit.apps.texture.candidates import NO_PHOTO
from surfkit.apps.texture.topology import NO_FACE as NO_FACE

CUT_CELL_PX = 256
"""Charts that are larger are cut along a grid of so many pixels: smaller pieces leave less room empty."""
PAD = 2
"""Texels around a chart: what is mixed with it when a page is shown reduced to a quarter is a copy of its rim."""
PATCH_SIDE = 4
"""Side of the square of texels of a triangle without a photograph."""
MAX_PATCHES_PER_SIDE = 64
"""Such squares along the side of a chart of them, at most."""
MAX_FILLED_SHARE = 0.6
"""Share of a page that is estimated to be taken, at most."""
MIN_PAGE_SIDE = 64
"""Side of a page."""


@dataclass(frozen=True)
class AtlasPage:
    """A picture of the atlas.

    Attributes:
        tile: Number of the tile that it belongs to.
        width: Texels, a power of two.
        height: The same.
    """

    tile: int
    width: int
    height: int


@dataclass(frozen=True)
class Atlas:
    """Where each triangle lies on which page.

    Attributes:
        view: (F,) int32 photograph of each triangle; NONE for none.
        chart: (F,) int32 number of its chart.
        places: (F, 3, 2) float32 x and y of its corners: pixels in its photograph, or texels in a chart of patches.
        tile: (F,) int32 its tile.
        page: (C,) int32 page of each chart.
        move: (C, 2) int64 from `places` to texels of the page.
        pages: The pages.
    """

    view: np.ndarray
    chart: np.ndarray
    places: np.ndarray
    tile: np.ndarray
    page: np.ndarray
    move: np.ndarray
    pages: list[AtlasPage]

    def texels(self, faces: np.ndarray) -> np.ndarray:
        """(n, 3, 2) float32 x and y of the corners of some triangles on their page."""
        return (self.places[faces] + self.move[self.chart[faces]][:, None]).astype(np.float32)


def make_atlas(view: np.ndarray, places: np.ndarray, tile: np.ndarray, beyond: np.ndarray, side: int) -> Atlas:
    """Cut triangles into charts, and place these on pages of at most `side` texels; each page belongs to one tile.

    Args:
        view: (F,) photograph of each triangle; NONE for none.
        places: (F, 3, 2) corners in the photograph, of triangles no wider or higher than half a `side`: a chart has
            the middles of its triangles within a quarter, so it fits. Changed where there is no photograph.
        tile: (F,) tile of each triangle.
        beyond: (F, 3) triangles beyond the edges.
        side: A power of two.
    """
    chart = _charts(view, places, tile, beyond, side)
    order = np.argsort(chart, kind="stable")
    first = np.flatnonzero(np.diff(chart[order], prepend=-1))
    low = np.floor(np.minimum.reduceat(places.min(1)[order], first)).astype(np.int64) - PAD
    high = np.ceil(np.maximum.reduceat(places.max(1)[order], first)).astype(np.int64) + PAD
    alone = view[order[first]] == NO_PHOTO
    low[alone], high[alone] = 0, high[alone] - PAD + 1  # patches have their rims: up to their fourth texel
    size, owner = high - low, tile[order[first]]
    page, corner = np.zeros(len(first), np.int32), np.zeros((len(first), 2), np.int64)
    pages: list[AtlasPage] = []
    for number in range(int(tile.max()) + 1):
        rows = np.flatnonzero(owner == number)
        if not len(rows):
            continue
        at, corner[rows], shapes = packed(size[rows], side)
        page[rows] = at + len(pages)
        pages += [AtlasPage(number, *shape) for shape in shapes]
    return Atlas(view, chart, places, tile, page, corner - low, pages)


def _charts(view: np.ndarray, places: np.ndarray, tile: np.ndarray, beyond: np.ndarray, side: int) -> np.ndarray:
    """(F,) int32 number of the chart of each triangle; places of those without a photograph are set."""
    seen, patches = view != NO_PHOTO, min(MAX_PATCHES_PER_SIDE, side // PATCH_SIDE)
    grid = np.floor(places.mean(1) / min(CUT_CELL_PX, side // 4)).astype(np.int64)
    same = (beyond != NO_FACE) & seen[:, None] & (view[:, None] == view[beyond]) & (tile[:, None] == tile[beyond])
    same &= (grid[:, None] == grid[beyond]).all(2)
    row, edge = np.nonzero(same)
    graph = coo_matrix((np.ones(len(row), bool), (row, beyond[row, edge])), (len(view), len(view)))
    part = connected_components(graph, directed=False)[1].astype(np.int64)
    alone = np.flatnonzero(~seen)
    alone = alone[np.argsort(tile[alone], kind="stable")]
    begins = np.searchsorted(tile[alone], tile[alone])
    within = np.arange(len(alone)) - begins
    part[alone] = len(view) + (begins + within // patches**2)  # blocks of a tile begin at different numbers
    row, column = np.divmod(within % patches**2, patches)
    corner = np.array([[1.5, 1.5], [2.5, 1.5], [1.5, 2.5]])
    places[alone] = PATCH_SIDE * np.stack([column, row], axis=1)[:, None] + corner
    return np.unique(part, return_inverse=True)[1].astype(np.int32)


def packed(size: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, list[tuple[int, int]]]:
    """Rectangles on shelves: (C,) page of each, (C, 2) its upper left corner, and width and height of the pages.

    The pages are as small as powers of two can be, and as few as these shelves allow.

    Args:
        size: (C, 2) width and height, at most `side`.
        side: Largest page, a power of two.
    """
    wanted = MIN_PAGE_SIDE
    while wanted < side and (wanted < size.max() or wanted**2 < size.prod(1).sum()):
        wanted *= 2
    while True:
        page, corner, rows = _shelves(size, wanted)
        if page.max() == 0 or wanted >= side:
            break
        wanted *= 2
    height = MIN_PAGE_SIDE
    while height < rows:  # of the last page
        height *= 2
    return page, corner, [(wanted, wanted)] * int(page.max()) + [(wanted, min(height, wanted))]


def _shelves(size: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Pages, corners, and rows that are taken of the last page."""
    page, corner = np.zeros(len(size), np.int32), np.zeros((len(size), 2), np.int64)
    at = x = y = shelf = 0
    order = np.lexsort((-size[:, 0], -size[:, 1]))
    for row, (width, height) in zip(order.tolist(), size[order].tolist(), strict=True):
        if x + width > side:
            x, y, shelf = 0, y + shelf, 0
        if y + height > side:
            at, x, y, shelf = at + 1, 0, 0, 0
        page[row], corner[row] = at, (x, y)
        x, shelf = x + width, max(shelf, height)
    return page, corner, y + shelf


def texels_of(view: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(F,) estimate of the texels that triangles take on a page, with their shares of rims and gaps."""
    ahead, across = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    area = np.abs(ahead[:, 0] * across[:, 1] - ahead[:, 1] * across[:, 0]) / 2
    return np.where(view == NO_PHOTO, PATCH_SIDE**2, 1.5 * area + 2).astype(np.float64)
