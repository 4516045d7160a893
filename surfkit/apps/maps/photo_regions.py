"""Which photograph the parts of an orthophoto are from: few, large regions with cut lines where they do not show.

It is chosen for the whole map at once, on blocks of cells. The cost of a block is what its photograph lacks in quality
(Lempitsky and Ivanov, Seamless Mosaicing of Image-Based Texture Maps, CVPR 2007); that of a cut line is the difference
of the two photographs on both sides (Kwatra et al., Graphcut Textures, SIGGRAPH 2003), less along edges in them, and
more on what rises above its surroundings. Alpha expansion finds a low sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from surfkit.apps.maps.graph_cut import expanded
from surfkit.apps.maps.map_grid import MapGrid
from surfkit.apps.maps.photo_sight import between, look
from surfkit.apps.maps.rasters import NODATA
from surfkit.apps.texture.candidates import NO_PHOTO, Candidates
from surfkit.apps.texture.find_candidates import LOOKED_FOLDER, candidates_of
from surfkit.apps.texture.pieces import MeshClusters, box_corners, may_show
from surfkit.apps.texture.prefetch_photos import PrefetchedPhotos
from surfkit.apps.texture.texture_cache import Arrays, TextureCache
from surfkit.apps.texture.triangle_visibility import EDGE_QUALITY, TriangleVisibility
from surfkit.scene.camera import Camera
from surfkit.scene.one_light import OneLight, sensor_places
from surfkit.scene.scene import Frame, View

MIN_BLOCK_CELLS, MAX_BLOCKS = 4, 1_000_000
"""Cells along a side of a block: a power of two, the least that gives no more blocks than this."""
SAMPLES = 2
"""Places along a side of a block at which photographs are looked at."""
GROUP_BLOCKS = 64
"""Blocks along a side of a group that is looked at, or not, as a whole."""
RIM_SHARE = 0.05
"""Of the sides of a photograph: from here to the border, its quality goes to a tenth."""
SEAM_SHARE = 0.05
"""Cost of a cut line of one block, of that of a block without quality, times the blocks across a photograph: the
smaller blocks are, the more of them each side of a line can gain."""
SEAM_DIFFERENCE, LEAST_SEAM, MOST_SEAM = 0.04, 0.25, 4.0
"""Difference of two colours, of 1, that costs as much as stated above, and bounds of the cost in proportion to it."""
UNKNOWN_DIFFERENCE = 0.16
"""Where only one of the two photographs shows both sides."""
EDGE_DIFFERENCE = 0.1
"""Of neighbouring blocks in one photograph, at which a cut line between them costs half."""
RAISED_COST, RAISED_SHARE, OPENING_SHARE = 8.0, 0.02, 0.5
"""How much more a cut line costs on what rises by more than a share of the height of the cameras above its
surroundings, and how far these reach, as a share of that height too."""
UNSEEN_COST, UNSEEN_BLOCKS = 1.5, 3
"""Cost of a photograph at a block that it does not show, as others have its cells then, and how far from blocks that it
shows such a block may lie."""


@dataclass(frozen=True)
class PhotoRegions:
    """The photographs of an orthophoto.

    Attributes:
        block: Cells along a side of a block.
        label: (h, w) int32 photograph of each block; NO_PHOTO where none shows it.
        view: (h, w, K) int32 the photographs that show it best, in this order; NO_PHOTO for none.
        light: Of the photographs.
    """

    block: int
    label: np.ndarray
    view: np.ndarray
    light: OneLight


class Blocks:
    """The blocks of a map with a surface, as places of it.

    Args:
        grid: The map.
        frame: Of the data set.
        heights: Its surface model, a file.
    """

    def __init__(self, grid: MapGrid, frame: Frame, heights: Path) -> None:
        self.size = MIN_BLOCK_CELLS
        while -(-grid.width // self.size) * -(-grid.height // self.size) > MAX_BLOCKS:
            self.size *= 2
        self.shape = -(-grid.height // self.size), -(-grid.width // self.size)
        row, column = (self._sampled(side) for side in self.shape)
        height = sampled_heights(heights, row, column)
        cells = np.stack([*np.broadcast_arrays(column + 0.5, row[:, None] + 0.5), height], axis=-1)
        places = frame.to_local(grid.from_cells(cells)).astype(np.float32)
        h, w = self.shape
        grouped = places.reshape(h, SAMPLES, w, SAMPLES, 3).transpose(0, 2, 1, 3, 4).reshape(h * w, SAMPLES**2, 3)
        heights_of = height.reshape(h, SAMPLES, w, SAMPLES).transpose(0, 2, 1, 3).reshape(h, w, SAMPLES**2)
        with_surface = np.isfinite(heights_of)
        count = with_surface.sum(2)
        self.height = np.where(with_surface, heights_of, 0).sum(2) / np.where(count, count, np.nan)
        self.places, self.count = grouped, count.reshape(-1)
        self.up, self.cell = grid.turn[2], grid.gsd * frame.scale
        self._group()

    def _sampled(self, side: int) -> np.ndarray:
        """Rows, or columns, of the cells that blocks are sampled at."""
        within = (2 * np.arange(SAMPLES) + 1) * self.size // (2 * SAMPLES)
        return (np.arange(side)[:, None] * self.size + within).ravel()

    def _group(self) -> None:
        """Sort the blocks into groups that lie close together."""
        row, column = np.divmod(np.arange(len(self.places)), self.shape[1])
        number = row // GROUP_BLOCKS * -(-self.shape[1] // GROUP_BLOCKS) + column // GROUP_BLOCKS
        number[self.count == 0] = -1
        order = np.argsort(number, kind="stable")[np.count_nonzero(number < 0) :]
        starts = np.flatnonzero(np.diff(number[order], prepend=-1))
        low, high = np.nanmin(self.places[order], axis=1), np.nanmax(self.places[order], axis=1)
        self.rows = np.split(order, starts[1:])
        self.boxes = box_corners(np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts))

    def in_view(self, camera: Camera) -> np.ndarray:
        """Rows of the blocks that may lie in a picture, rising."""
        shown = np.flatnonzero(may_show(self.boxes, camera))
        return np.sort(np.concatenate([np.empty(0, np.int64), *(self.rows[at] for at in shown)]))

    def shown(
        self, camera: Camera, picture: np.ndarray, keep: np.ndarray | None, pieces: MeshClusters
    ) -> TriangleVisibility | None:
        """What a photograph shows of the blocks; None for nothing.

        The quality is the pixels of a cell, times the cosine between the ray and the vertical, times the square of the
        share of the block that is seen well.
        """
        rows = self.in_view(camera)
        places = self.places[rows].reshape(-1, 3)
        sight = look(places, camera, pieces, keep)
        if not len(sight.rows):
            return None
        owner = sight.rows // SAMPLES**2
        colors = between(picture, sight.x, sight.y)
        used, at, count = np.unique(owner, return_inverse=True, return_counts=True)
        mean = np.stack([np.bincount(at, each) for each in (*colors.T, sight.x, sight.y)], axis=1) / count[:, None]
        good = np.bincount(at, np.where(sight.clear, 1.0, EDGE_QUALITY**0.5)) / self.count[rows[used]]
        quality = np.bincount(at, self._qualities(places[sight.rows], sight.x, sight.y, camera)) / count * good**2
        place = sensor_places(camera, mean[:, 3], mean[:, 4])
        color = np.rint(mean[:, :3]).astype(np.uint8)
        return TriangleVisibility(rows[used], quality.clip(1e-6).astype(np.float32), color, place)

    def _qualities(self, places: np.ndarray, x: np.ndarray, y: np.ndarray, camera: Camera) -> np.ndarray:
        """(n,) pixels that a level cell takes, times the cosine to the vertical, less towards the border."""
        rays = camera.centre.numpy() - places
        above = rays @ self.up
        depth = -rays @ camera.world_to_camera[2, :3].numpy()
        pixels = camera.fx * camera.fy * self.cell**2 * np.abs(above) / np.maximum(depth, 1e-12) ** 3
        rim = np.minimum(
            np.minimum(x, camera.width - x) / camera.width, np.minimum(y, camera.height - y) / camera.height
        )
        return pixels * np.abs(above) / np.linalg.norm(rays, axis=1) * (rim / RIM_SHARE).clip(0.1, 1)


def sampled_heights(file: Path, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(R, C) float64 heights of a raster at some rows and columns; NaN without a surface, and beyond its borders."""
    import rasterio
    from rasterio.windows import Window

    with rasterio.open(file) as raster:
        found = np.full((len(rows), len(columns)), np.nan)
        known, across = rows < raster.height, columns < raster.width
        for at in np.flatnonzero(known):
            line = raster.read(1, window=Window(0, int(rows[at]), raster.width, 1))[0, columns[across]]
            found[at, across] = np.where(line == NODATA, np.nan, line)
    return found


class RegionEnergy:
    """What photographs of the blocks cost: see `LabelEnergy`.

    Args:
        found: The photographs of each block.
        light: Of the photographs.
        weight: (h, w) of a cut line at each block.
    """

    def __init__(self, found: Candidates, light: OneLight, weight: np.ndarray) -> None:
        self.view = found.view
        best = np.maximum(found.quality.max(1, keepdims=True), 1e-30)
        self.lack = 1 - found.quality / best
        self.color = light.even_at(found.color / 255, found.view, found.place.astype(float)).astype(np.float32)
        number = np.arange(weight.size).reshape(weight.shape)
        known = found.view.max(1) != NO_PHOTO
        ends = np.concatenate([
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], 1),
            np.stack([number[:-1].ravel(), number[1:].ravel()], 1),
        ])  # fmt: skip
        self.edges = ends[known[ends].all(1)]
        there = (found.view != NO_PHOTO)[..., None]
        mean = np.where(there, self.color, 0).sum(1) / np.maximum(there.sum(1), 1)
        step = np.abs(mean[self.edges[:, 0]] - mean[self.edges[:, 1]]).mean(1)
        self.weight = weight.reshape(-1)[self.edges].min(1) / (1 + step / EDGE_DIFFERENCE)
        self.known = known.reshape(weight.shape)
        row, slot = np.nonzero(there[..., 0])
        order = np.argsort(found.view[row, slot], kind="stable")
        self.labels, starts = np.unique(found.view[row, slot][order], return_index=True)
        self.rows = dict(zip(self.labels.tolist(), np.split(row[order], starts[1:]), strict=False))

    def nodes_of(self, label: int) -> np.ndarray:
        """See `LabelEnergy`."""
        places = np.stack(np.divmod(self.rows[label], self.known.shape[1]))
        first = (places.min(1) - UNSEEN_BLOCKS).clip(0)
        part = tuple(slice(at, end + 1 + UNSEEN_BLOCKS) for at, end in zip(first, places.max(1), strict=True))
        shown = np.zeros_like(self.known[part])
        shown[tuple(places - first[:, None])] = True
        near = ndimage.maximum_filter(shown, 2 * UNSEEN_BLOCKS + 1, mode="constant") & self.known[part]
        row, column = np.nonzero(near)
        return (row + first[0]) * self.known.shape[1] + column + first[1]

    def _slots(self, nodes: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) slot of a photograph of each node, and whether it has it."""
        same = self.view[nodes] == label[:, None]
        return same.argmax(1), same.any(1)

    def node_costs(self, nodes: np.ndarray, label: np.ndarray) -> np.ndarray:
        """See `LabelEnergy`."""
        slot, there = self._slots(nodes, label)
        return np.where(there, self.lack[nodes, slot], UNSEEN_COST).astype(np.float64)

    def edge_costs(self, edges: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """See `LabelEnergy`."""
        found, cut = np.zeros(len(edges)), np.flatnonzero(one != other)
        edges, one, other = edges[cut], one[cut], other[cut]
        sums = np.zeros(len(cut))
        for nodes in self.edges[edges].T:
            (a, has_a), (b, has_b) = self._slots(nodes, one), self._slots(nodes, other)
            away = np.abs(self.color[nodes, a] - self.color[nodes, b]).mean(1)
            sums += np.where(has_a & has_b, away, UNKNOWN_DIFFERENCE) / 2
        found[cut] = self.weight[edges] * (sums / SEAM_DIFFERENCE).clip(LEAST_SEAM, MOST_SEAM)
        return found


def find_regions(
    grid: MapGrid, frame: Frame, heights: Path, pieces: MeshClusters, photos: PrefetchedPhotos, kept: TextureCache
) -> PhotoRegions:
    """Choose the photographs of a map; each step is kept in `kept`, and not done again if it is there.

    Args:
        grid: The map.
        frame: Of the data set.
        heights: Its surface model, a file.
        pieces: The mesh, local frame.
        photos: To choose from.
        kept: For what is finished.
    """
    blocks = Blocks(grid, frame, heights)

    def choose() -> Arrays:
        def show(number: int, picture: np.ndarray, keep: np.ndarray | None) -> TriangleVisibility | None:
            return blocks.shown(photos.views[number].camera, picture, keep, pieces)

        found, light, _ = candidates_of(len(blocks.places), photos, show, kept)
        flown = flight_height(photos.views, frame, grid, blocks.height)
        weight = seam_weights(blocks.height, flown, grid.gsd * blocks.size)
        weight *= SEAM_SHARE * photograph_blocks(photos.views, flown, grid.gsd * blocks.size)
        energy = RegionEnergy(found, light, weight)
        best = found.view[np.arange(len(found.view)), found.quality.argmax(1)]
        view = np.take_along_axis(found.view, np.argsort(-found.quality, axis=1, kind="stable"), axis=1)
        return {"label": expanded(energy, best, energy.labels), "view": view, **vars(light)}

    chosen = kept.once("regions", choose)
    kept.forget(LOOKED_FOLDER)
    label = chosen["label"].reshape(blocks.shape).astype(np.int32)
    view = chosen["view"].reshape(*blocks.shape, -1)
    return PhotoRegions(blocks.size, label, view, OneLight.restored(chosen))


def flight_height(views: Sequence[View], frame: Frame, grid: MapGrid, height: np.ndarray) -> float:
    """Median height of the cameras above the median of the (h, w) surface, units of the input; at least a cell."""
    centres = grid.to_map(frame.to_input(np.stack([view.camera.centre.numpy() for view in views])))
    return max(float(np.median(centres[:, 2]) - np.nanmedian(height)), grid.gsd)


def photograph_blocks(views: Sequence[View], flown: float, side: float) -> float:
    """Blocks, of a side in units of the input, across a photograph that looks down; 1 or more."""
    return max(1.0, flown / side * float(np.median([view.camera.width / view.camera.fx for view in views])))


def seam_weights(height: np.ndarray, flown: float, side: float) -> np.ndarray:
    """(h, w) what a cut line costs at each block, of that on the ground: more on buildings and trees.

    Args:
        height: (h, w) of the surface; NaN for none.
        flown: Height of the cameras above it.
        side: Of a block, in the same units.
    """
    known = np.isfinite(height)
    if not known.all():
        nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    reach = max(3, int(np.ceil(OPENING_SHARE * flown / side)))
    above = height - ndimage.grey_opening(height, (reach, reach))
    return 1 + RAISED_COST * (above / (RAISED_SHARE * flown)).clip(0, 1)
