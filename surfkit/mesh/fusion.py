"""Fusing views one after another into a grid; in tiles where it would become too large."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.files import FILE_PREFIX, remove
from surfkit.mesh.base import Mesh
from surfkit.mesh.cuda.gpu_grid import GpuGrid
from surfkit.mesh.floaters import drop_floaters
from surfkit.mesh.fusion_image import weighed
from surfkit.mesh.grid_tiles import BlockRange, join
from surfkit.mesh.lattice import (
    BLOCK_SIDE_VOXELS,
    MAX_BLOCKS_FROM_ORIGIN,
    Corner,
    FusionImage,
    Lattice,
    SurfacePatch,
    TsdfGrid,
)
from surfkit.mesh.native_grid import grid
from surfkit.mesh.overlap import Depths
from surfkit.scene.arrays import write_array
from surfkit.scene.camera import Camera

TILES_PATTERN = f"{FILE_PREFIX}tiles-*"
"""Pattern of the names of folders with the depth maps of the views."""
FUSION_PIXEL_BYTES = 12
"""Bytes per pixel of a view on disk."""
Made = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices, faces, colours."""


@dataclass(frozen=True)
class FusionTask:
    """What is to be fused, and how.

    Attributes:
        lattice: Of all tiles.
        cameras: Of the views.
        see: What the view at a position sees; costly.
        limit: Largest depth, local units.
        carve: Let each view clear all that it sees through.
        least_weight: From which a voxel counts.
        scratch: Folder for what the views see, if there are tiles, or views are compared.
        label: Of the progress.
        compare: What the weights of the pixels of a view are multiplied with, by what all views see; None leaves them.
        floaters: Connected components are dropped that are seen through so many times as often as seen; 0 keeps all.
        stored: Whether `see` costs little, as what the views see is on disk.
        device: Where depth maps are fused.
    """

    lattice: Lattice
    cameras: tuple[Camera, ...]
    see: Callable[[int], FusionImage]
    limit: float
    carve: bool
    least_weight: int
    scratch: Path | None
    label: str = "fusing views"
    compare: Callable[[int, Depths], Tensor] | None = None
    floaters: float = 0.0
    stored: bool = False
    device: torch.device = torch.device("cpu")


def fuse(task: FusionTask, boxes: list[BlockRange]) -> tuple[Made, dict[str, int]]:
    """Vertices, faces and colours of the surface, and the numbers of tiles and, if they are looked for, of floaters.

    Args:
        task: What is to be fused.
        boxes: Of the tiles; those that turn out to need too many blocks are cut further.
    """
    with nullcontext(task) if task.compare is None else spooled(task) as ready:
        made, tiles = fuse_ready(ready, boxes)
        if not task.floaters or not len(made[1]):
            return made, {"tiles": tiles}
        made, floaters = see_through(ready, made)
        return made, {"tiles": tiles, "floaters": floaters}


def see_through(task: FusionTask, made: Made) -> tuple[Made, int]:
    """The surface without its floaters, and their number."""

    def pictures() -> Iterator[FusionImage]:
        for at in range(len(task.cameras)):
            yield task.see(at)
            emit(Progress("looking for floaters", at + 1, len(task.cameras)))

    mesh, dropped = drop_floaters(Mesh(*made), pictures(), task.lattice.truncation, task.floaters)
    return (mesh.vertices, mesh.faces, made[2]), dropped


def fuse_ready(task: FusionTask, boxes: list[BlockRange]) -> tuple[Made, int]:
    """Vertices, faces and colours, and the number of tiles, of views whose weights are what they will be."""
    if len(boxes) == 1:
        whole = empty(task, task.lattice)
        if all(step(task, whole, at) for at in range(len(task.cameras))):
            piece = whole.surface(task.least_weight)
            return (piece.vertices, piece.faces, piece.colors), 1
        del whole
        emit(Warned("the grid became larger than expected: starting again in tiles"))
        boxes = cut(BlockRange(), task)
    with nullcontext(task) if task.stored else spooled(task) as stored:
        return in_tiles(stored, boxes)


def empty(task: FusionTask, lattice: Lattice) -> TsdfGrid:
    """A grid where the depth maps are fused."""
    return GpuGrid(lattice, task.device) if task.device.type == "cuda" else grid(lattice)


def step(task: FusionTask, into: TsdfGrid, at: int) -> bool:
    """Fuse one view; False if there would be too many blocks."""
    fits = into.fuse(task.see(at), task.carve)
    emit(Progress(task.label, at + 1, len(task.cameras)))
    return fits


def in_tiles(task: FusionTask, boxes: list[BlockRange]) -> tuple[Made, int]:
    """The surface, tile by tile."""
    views = [in_sight(camera, task) for camera in task.cameras]
    left, pieces, made = list(reversed(boxes)), [], 0
    while left:
        box = left.pop()
        piece = tile(task, box, views)
        if piece is None:
            left += reversed(cut(box, task))
            continue
        made += 1
        emit(Progress("fusing tiles", made, made + len(left)))
        if len(piece.faces):
            pieces.append(piece)
    if not pieces:
        return (np.empty((0, 3), np.float32), np.empty((0, 3), np.int32), np.empty((0, 3), np.uint8)), made
    return join(pieces), made


def tile(task: FusionTask, box: BlockRange, views: list[BlockRange]) -> SurfacePatch | None:
    """The surface in a box; None if its grid would become too large."""
    around = box.with_border()
    part = empty(task, replace(task.lattice, low=around.low, high=around.high))
    for at, view in enumerate(views):
        if view.meets(around) and not part.fuse(task.see(at), task.carve):
            return None
    return used(part.surface(task.least_weight, box.high, with_edges=True))


def used(piece: SurfacePatch) -> SurfacePatch:
    """Without the vertices that no face has: those of the border."""
    there = np.zeros(len(piece.vertices), bool)
    there[piece.faces] = True
    place = (np.cumsum(there) - 1).astype(np.int32)
    return SurfacePatch(piece.vertices[there], place[piece.faces], piece.colors[there], piece.edges[there])


def cut(box: BlockRange, task: FusionTask) -> list[BlockRange]:
    """A box in two."""
    seen = in_sight(task.cameras[0], task)
    for camera in task.cameras[1:]:
        seen = seen.joined(in_sight(camera, task))
    halves = box.halves(seen)
    if halves is None:
        raise BadInput(
            f"{task.lattice.most_blocks} blocks of voxels do not hold one tile; give more --memory, or larger voxels"
        )
    return list(halves)


def in_sight(camera: Camera, task: FusionTask) -> BlockRange:
    """Blocks around all that a camera may see."""
    pose = camera.world_to_camera.numpy()
    x = (np.array([0, camera.width]) - camera.cx) / camera.fx
    y = (np.array([0, camera.height]) - camera.cy) / camera.fy
    rays = np.array([[0, 0, 0], *([a, b, 1] for a in x for b in y)]) * task.limit
    corners = (rays - pose[:3, 3]) @ pose[:3, :3] / (task.lattice.voxel * BLOCK_SIDE_VOXELS)
    margin = 1 + np.ceil(task.lattice.truncation / task.lattice.least_slant / (task.lattice.voxel * BLOCK_SIDE_VOXELS))
    low, high = np.floor(corners.min(0)) - margin, np.floor(corners.max(0)) + 1 + margin
    return BlockRange(_corner(low), _corner(high))


def _corner(at: np.ndarray) -> Corner:
    x, y, z = (int(v) for v in at.clip(1 - MAX_BLOCKS_FROM_ORIGIN, MAX_BLOCKS_FROM_ORIGIN - 1))
    return x, y, z


def forget_spooled(scratch: Path) -> None:
    """Delete from a folder what `spooled` left there in a process that was killed."""
    for left in scratch.glob(TILES_PATTERN):
        remove(left)


@contextmanager
def spooled(task: FusionTask) -> Iterator[FusionTask]:
    """The task with what every view sees on disk, so that it is drawn once however often it is looked at, and compared
    with other views if that is wanted."""
    needed = FUSION_PIXEL_BYTES * sum(camera.width * camera.height for camera in task.cameras)
    with tempfile.TemporaryDirectory(dir=task.scratch, prefix=TILES_PATTERN.rstrip("*")) as name:
        folder = Path(name)
        if (free := shutil.disk_usage(folder).free) < 1.05 * needed:
            raise BadInput(
                f"{folder.parent}: {needed / 1e9:.1f} GB of disk are needed to mesh in tiles and {free / 1e9:.1f} GB "
                "are free; make room, give more --memory, or larger voxels"
            )
        for at in range(len(task.cameras)):
            seen = task.see(at)
            with (folder / f"{at}.npy").open("wb") as file:
                write_array(file, np.stack([seen.depth.view(np.uint32), seen.shade, seen.slants.view(np.uint32)]))
            emit(Progress("drawing views", at + 1, len(task.cameras)))

        def read(at: int) -> FusionImage:
            depth, shade, slant = np.load(folder / f"{at}.npy")
            return FusionImage(depth.view(np.float32), shade, task.cameras[at], slant.view(np.float32))

        if task.compare is not None:
            compare(task, task.compare, folder)
        yield replace(task, see=read, compare=None, stored=True)


def compare(task: FusionTask, trust_of: Callable[[int, Depths], Tensor], folder: Path) -> None:
    """Multiply the weights of the views on disk; depths stay, so the order of the views does not matter."""

    def depth(at: int) -> Tensor:
        return torch.from_numpy(np.load(folder / f"{at}.npy", mmap_mode="r")[0].view(np.float32).copy())

    depths = Depths(task.cameras, depth)
    for at in range(len(task.cameras)):
        trust = trust_of(at, depths).numpy()
        shade = np.load(folder / f"{at}.npy", mmap_mode="r+")[1]
        shade[:] = weighed(np.asarray(shade), trust)
        emit(Progress("comparing views", at + 1, len(task.cameras)))
