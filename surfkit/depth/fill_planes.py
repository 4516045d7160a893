"""Holes of depth maps filled with planes that the trusted depth at their rim lies on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, find_objects, uniform_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from surfkit.core.check import require_within
from surfkit.depth.base import DepthInput
from surfkit.depth.fill_base import MIN_FITTING_SHARE, SEEN_THROUGH, Fill, FillInput

DRAWS = 64
"""Planes through three pixels of a rim that are tried (RANSAC, Fischler and Bolles 1981)."""
MIN_RIM_PIXELS = 12
"""Fewer trusted pixels tell no plane."""
MIN_HOLE_PIXELS = 16
"""Smaller holes are left empty: they are many, and worth little."""
MIN_SIDE_PX = 8
"""A hole that one plane does not fit is halved while its longer side is at least twice this."""
MAX_FREE_SHARE = 0.1
"""Share of a plane that may lie where other views see through; more, and the whole of it is left out."""
PLANE_FILL_RANGES = {"contrast": (1e-6, 1), "rim": (1, 1000), "tolerance": (1e-6, 1), "reach": (0.1, 100)}


@dataclass(frozen=True)
class PlaneFill(Fill):
    """A plane for each hole of one colour, if the trusted pixels at its rim lie on one: roofs, roads, lawns.

    A plane in space is linear in inverse depth. It is found by RANSAC and fitted to the pixels that agree, four fifths
    of the rim at least; a hole whose rim disagrees is halved until its parts agree or are small. A plane goes no
    farther from its rim than `reach`, and is left out where a tenth of it lies in space that other views see through.
    """

    contrast: float = 0.03
    """Largest difference of colours, in [0, 1], between neighbouring pixels of one region; in the mean of three by
    three pixels."""

    rim: int = 6
    """Width of the rim that a plane is fitted to, pixels of the depth map."""

    tolerance: float = 0.005
    """Largest difference between the plane and the inverse depth of a rim pixel, as a share of that."""

    reach: float = 2.5
    """How far a plane goes from the middle of its rim, in standard deviations of the rim along that direction: the
    middle of a ring is at 0, the ring itself at 1.4. A rim at one side only says little of what lies opposite."""

    def __post_init__(self) -> None:
        require_within(PLANE_FILL_RANGES, self)

    def opened(self, given: DepthInput, wanted: Sequence[int]) -> Callable[[FillInput], Tensor]:
        """See `Fill.opened`."""
        return self.planes

    def planes(self, given: FillInput) -> Tensor:
        """(h, w) inverse depth of the planes that fit, 0 elsewhere."""
        inverse, holes = given.inverse.numpy().astype(np.float64), given.holes.numpy()
        regions, pieces = colour_regions(given.photo.numpy(), holes, self.contrast)
        draw, found = np.random.default_rng(0), np.zeros(holes.shape, np.float32)
        owner, count = np.zeros(holes.shape, np.int64), 0
        boxes = find_objects(pieces)
        sizes = np.bincount(pieces.ravel())[1:]
        small = int(sizes[sizes < MIN_HOLE_PIXELS].sum())
        given.tell(f"holes of one colour have less than {MIN_HOLE_PIXELS} pixels", small)
        for at in 1 + np.flatnonzero(sizes >= MIN_HOLE_PIXELS):
            box = boxes[at - 1]
            rows, columns = (slice(max(0, side.start - self.rim), side.stop + self.rim) for side in box)
            hole = pieces[rows, columns] == at
            alike = regions[rows, columns] == regions[rows, columns][hole][0]
            for part, values in self.fitted(hole, alike, inverse[rows, columns], draw):
                count += 1
                found[rows, columns][part], owner[rows, columns][part] = values, count
        left = int(sizes.sum() - small - (owner > 0).sum())
        given.tell(f"trusted pixels beside them lie on no plane to {self.tolerance:.2%}, or too far away", left)
        free = np.bincount(owner[given.is_free(torch.from_numpy(found)).numpy()], minlength=count + 1)
        stays = free <= MAX_FREE_SHARE * np.bincount(owner.ravel(), minlength=count + 1)
        given.tell(SEEN_THROUGH, int((~stays[owner] & (owner > 0)).sum()))
        return torch.from_numpy(np.where(stays[owner], found, 0))

    def fitted(
        self, hole: np.ndarray, alike: np.ndarray, inverse: np.ndarray, draw: np.random.Generator
    ) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], np.ndarray]]:
        """Rows and columns of parts of a hole, and their inverse depths.

        Args:
            hole: (h, w) bool, the hole, in a box with room for its rim.
            alike: (h, w) bool, pixels of the same region of colour.
            inverse: (h, w) trusted inverse depth, 0 elsewhere.
            draw: Of pixels.
        """
        rim = alike & (inverse > 0)
        if rim.sum() >= MIN_RIM_PIXELS:
            rim &= distance_transform_edt(~hole) <= self.rim
        plane = self.plane(np.argwhere(rim).astype(np.float64), inverse[rim], draw) if rim.any() else None
        if plane is not None:
            (middle, spread), coefficients = plane
            places = np.argwhere(hole) - middle
            near = np.einsum("ki,ij,kj->k", places, spread, places) <= self.reach**2
            values = places @ coefficients[:2] + coefficients[2]
            keep = near & (values > 0)
            rows, columns = np.nonzero(hole)
            if keep.any():
                yield (rows[keep], columns[keep]), values[keep].astype(np.float32)
            return
        rows, columns = np.nonzero(hole)
        tall = np.ptp(rows) >= np.ptp(columns)
        along = rows if tall else columns
        if np.ptp(along) + 1 >= 2 * MIN_SIDE_PX:
            lower = np.zeros_like(hole)
            first = along <= (along.min() + along.max()) // 2
            lower[rows[first], columns[first]] = True
            for part in (lower, hole & ~lower):
                yield from self.fitted(part, alike, inverse, draw)

    def plane(
        self, at: np.ndarray, inverse: np.ndarray, draw: np.random.Generator
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray] | None:
        """A plane on which most of a rim lies: the middle of the rim (2,) and the inverse of its covariance (2, 2), and
        (3,) slopes and inverse depth in the middle; None if there is none.

        Args:
            at: (K, 2) pixels of the rim.
            inverse: (K,) their inverse depth.
            draw: Of pixels.
        """
        if len(at) < MIN_RIM_PIXELS:
            return None
        middle = at.mean(0)
        known = np.column_stack([at - middle, np.ones(len(at))])
        three = draw.integers(len(at), size=(DRAWS, 3))
        corners = known[three]
        usable = np.abs(np.linalg.det(corners)) > 1.0  # pixels in a row tell no plane
        if not usable.any():
            return None
        tried = np.linalg.solve(corners[usable], inverse[three[usable]][..., None])[..., 0]
        agrees = np.abs(tried @ known.T - inverse) <= self.tolerance * inverse
        best = agrees[agrees.sum(1).argmax()]
        if best.mean() < MIN_FITTING_SHARE:
            return None
        coefficients = np.linalg.lstsq(known[best], inverse[best], rcond=None)[0]
        if (np.abs(known @ coefficients - inverse) <= self.tolerance * inverse).mean() < MIN_FITTING_SHARE:
            return None
        covariance = np.cov((at - middle).T) + np.eye(2) / 12  # of the area of a pixel
        return (middle, np.linalg.inv(covariance)), coefficients


def colour_regions(photo: np.ndarray, holes: np.ndarray, contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) regions that neighbours of like colour connect, from 1; and connected holes within them, 0 elsewhere.

    Args:
        photo: (3, H, W) in [0, 1].
        holes: (H, W) bool.
        contrast: See `PlaneFill`.
    """
    smooth = np.stack([uniform_filter(channel.astype(np.float64), 3) for channel in photo])
    number = np.arange(holes.size).reshape(holes.shape)
    alike = [
        (number[one][like], number[other][like])
        for one, other in ((np.s_[..., :-1], np.s_[..., 1:]), (np.s_[..., :-1, :], np.s_[..., 1:, :]))
        for like in [np.abs(smooth[one] - smooth[other]).max(0) <= contrast]
    ]
    a, b = (np.concatenate(ends) for ends in zip(*alike, strict=True))
    inside = holes.ravel()[a] & holes.ravel()[b]
    regions, pieces = (
        connected_components(coo_matrix((np.ones(len(x), np.int8), (x, y)), (holes.size,) * 2), directed=False)[1] + 1
        for x, y in ((a, b), (a[inside], b[inside]))
    )
    kept = np.where(holes, pieces.reshape(holes.shape), 0)
    return regions.reshape(holes.shape), np.unique(kept, return_inverse=True)[1].reshape(holes.shape) + (0 not in kept)
