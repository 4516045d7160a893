"""What the compiled grid of signed distances and its reference share: the lattice, one view, and what comes out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from surfkit.scene.camera import Camera

BLOCK_SIDE_VOXELS = 8
"""Voxels along a block."""
BLOCK_BYTES = 7 * BLOCK_SIDE_VOXELS**3
FULL_WEIGHT = 32
"""Weight of a pixel that looks straight at a surface and is no larger than a voxel."""
BLOCK_REACH_VOXELS = 1.5
"""Blocks are made where a surface is nearer than this, in voxels, along any axis: cells around it must be whole."""
MIN_SLANT = 0.6
"""With a truncation of 4 voxels or more."""
SLANT_OF_VOXEL = 0.15
"""Least slant for each voxel of a shorter truncation."""
MAX_JUMP_VOXELS = 2.0
"""Neighbouring pixels whose depths differ by more than this, in voxels along the normal, are not of one surface."""
FADE_START_VOXELS = 1.0
"""Depth behind a surface, in voxels, from which the weight falls to 0 at the truncation: thin walls have two sides."""
BLOCK_INDEX_BITS = 17
MAX_BLOCKS_FROM_ORIGIN = 2 ** (BLOCK_INDEX_BITS - 1)
"""Blocks from the origin along an axis that can be numbered."""

Corner = tuple[int, int, int]


def least_slant(voxel: float, truncation: float) -> float:
    """The least slant of a pixel (see `FusionImage`): at smaller grazing angles, surfaces count as seen at this one.

    What is seen at a grazing angle is often round, and leaves the plane of a pixel. The plane is used as far as the
    truncation reaches, along the ray truncation / slant: with a short truncation at most 1 / `SLANT_OF_VOXEL` voxels,
    at angles as small as those at which a road is seen; with a longer one further, at angles above `MIN_SLANT`.

    Args:
        voxel: Local units.
        truncation: Local units.
    """
    return min(MIN_SLANT, SLANT_OF_VOXEL * truncation / voxel)


@dataclass(frozen=True)
class Lattice:
    """Voxels of one size, numbered from the origin of the local frame: voxel i lies at i times the size.

    Attributes:
        voxel: Local units.
        truncation: Local units; distances further in front of a surface count as this, further behind not at all.
        low: First block along x, y, z.
        high: One beyond the last.
        most_blocks: The grid does not take more.
    """

    voxel: float
    truncation: float
    low: Corner = (1 - MAX_BLOCKS_FROM_ORIGIN,) * 3
    high: Corner = (MAX_BLOCKS_FROM_ORIGIN - 1,) * 3
    most_blocks: int = 2**31 - 1

    def offsets(self, camera: Camera) -> np.ndarray:
        """(3, 512) float32 camera coordinates of the voxels of a block, x fastest, less those of the first."""
        z, y, x = np.indices((BLOCK_SIDE_VOXELS, BLOCK_SIDE_VOXELS, BLOCK_SIDE_VOXELS)).reshape(3, -1)
        turn = camera.world_to_camera[:3, :3].numpy()[:, :, None] * self.voxel
        return (turn[:, 0] * x + turn[:, 1] * y + turn[:, 2] * z).astype(np.float32)

    @property
    def least_slant(self) -> float:
        """See `least_slant`."""
        return least_slant(self.voxel, self.truncation)

    @property
    def lengths(self) -> list[float]:
        """Truncation, jump and fade in local units."""
        return [
            self.truncation,
            MAX_JUMP_VOXELS * self.voxel,
            min(FADE_START_VOXELS * self.voxel, 0.5 * self.truncation),
        ]


@dataclass(frozen=True)
class FusionImage:
    """What a view sees.

    Attributes:
        depth: (H, W) float32 camera z, local units; 0 for none, always finite.
        shade: (H, W) uint32, from the lowest byte up red, green, blue and a weight of up to `FULL_WEIGHT`, or more
        where
            it is trusted more.
        camera: Of the view.
        slant: (H, W) float32 distance from the plane that a pixel shows, for each unit of depth before or behind it:
            less than 1 where the surface is seen at an angle. None: 1.
    """

    depth: np.ndarray
    shade: np.ndarray
    camera: Camera
    slant: np.ndarray | None = None

    @property
    def slants(self) -> np.ndarray:
        """The slant of every pixel."""
        return np.ones(self.depth.shape, np.float32) if self.slant is None else self.slant


@dataclass(frozen=True)
class SurfacePatch:
    """A part of a surface.

    Attributes:
        vertices: (V, 3) float32 local.
        faces: (F, 3) int32.
        colors: (V, 3) uint8.
        edges: (V,) int64 the edge of the lattice that each vertex lies on, the same in every tile; may be empty.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    edges: np.ndarray


class TsdfGrid(ABC):
    """Distances, weights and colours of the voxels near surfaces."""

    @property
    @abstractmethod
    def blocks(self) -> int:
        """Blocks that there are."""

    @property
    @abstractmethod
    def bytes(self) -> int:
        """Memory that they take."""

    @abstractmethod
    def fuse(self, picture: FusionImage, carve: bool) -> bool:
        """Average a view into the voxels near what it sees, or with `carve` into all in sight that there are so far.

        False, and nothing is changed, if that took more blocks than the lattice allows.
        """

    @abstractmethod
    def surface(
        self, least_weight: int, end: Corner = (MAX_BLOCKS_FROM_ORIGIN,) * 3, with_edges: bool = False
    ) -> SurfacePatch:
        """Triangles where all eight voxels around have a weight, of cells in blocks below `end`; front faces see them
        counter-clockwise."""


class HostGrid(TsdfGrid):
    """A grid in the memory of the CPU."""

    @abstractmethod
    def put(self, keys: np.ndarray, distance: np.ndarray, weight: np.ndarray, color: np.ndarray) -> None:
        """Take blocks that another grid has fused, none of which is here.

        Args:
            keys: (B,) int64, the coordinates of each block: from the lowest bit up x, y and z plus
            `MAX_BLOCKS_FROM_ORIGIN`, `BLOCK_INDEX_BITS` each.
            distance: (B, 512) int16, in 1/32767 of the truncation.
            weight: (B, 512) uint16.
            color: (B, 3, 512) uint8.
        """
