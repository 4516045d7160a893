"""Of which photographs depth maps are whose shape does not tell: of distorted ones, or of the undistorted pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_files import DepthFile
from surfkit.io.datasets.depth_sampling import distorted
from surfkit.io.datasets.depth_units import points_in
from surfkit.scene.align import align, sample
from surfkit.scene.observations import Observations
from surfkit.scene.scene import Lens, Scene, View

COMPARED_MAPS = 32
"""Maps that are compared with sparse points, spread evenly: all of them are of one kind."""
MIN_SHIFT_PX = 1.0
"""Points that the lens moves by less, in pixels of the map, tell nothing."""
MIN_FIT_SHARE = 0.6
"""Share of the points that must fit better, at least."""
MIN_MAJORITY_SIGMAS = 3.0
"""By how many standard deviations of a coin thrown for each point they must be more than half, at least."""


@dataclass(frozen=True)
class Verdict:
    """Of which photographs the maps of a data set are whose shape fits both.

    Attributes:
        straight: Whether they are of the undistorted pictures.
        by: What tells so: the user, the sparse points, or nothing, so that it is assumed.
    """

    straight: bool = False
    by: Literal["user", "points", "nothing"] = "nothing"

    def line(self, bent: int, either: int) -> str | None:
        """What to say of it.

        Args:
            bent: How many maps are undistorted with their photographs.
            either: How many have a shape that fits both.
        """
        why = ": they fit the sparse points better so" if self.by == "points" and either else ""
        if self.straight and why:
            return f"{either} depth maps are of undistorted photographs{why}"
        if self.by == "nothing" and either:
            return (
                f"{bent} depth maps are taken for those of distorted photographs, and are undistorted with them: their "
                "shape is that of undistorted ones too, and no sparse points tell; if they are of undistorted ones, "
                "give --depth-of undistorted"
            )
        return f"{bent} depth maps are of distorted photographs, and are undistorted with them{why}" if bent else None


def lens_in(view: View, file: DepthFile, shape: Sequence[int], straight: bool) -> Lens | None:
    """The lens of a map of (height, width) that is of the distorted photograph; None if nothing in it is distorted.

    Args:
        view: The undistorted photograph.
        file: The map.
        shape: Of the map.
        straight: Whether a map that has the shape of both is of the undistorted one.
    """
    lens = view.lens
    if lens is None or file.straight or not has_shape(shape, lens.width, lens.height):
        return None
    return None if straight and has_shape(shape, view.camera.width, view.camera.height) else lens


def has_shape(shape: Sequence[int], width: int, height: int) -> bool:
    """Whether a map of (height, width) has the shape of a picture of a width and height."""
    wanted = shape[1] * height / width
    return abs(shape[0] - wanted) <= 1 + 0.01 * wanted


def refuse_unlike(values: np.ndarray, view: View, lens: Lens | None) -> None:
    """BadInput, in a few words, if (h, w) values are not a depth map of a photograph; `lens` is what distorts it."""
    height, width = values.shape
    if lens is None and not has_shape(values.shape, view.camera.width, view.camera.height):
        raise BadInput(f"{width} x {height} px is not the shape of its photograph")
    known = values[np.isfinite(values)]
    if not len(known):
        raise BadInput("no value in it")
    if np.ptp(known) <= 1e-6 * np.abs(known).max():
        raise BadInput("constant")


def fits_both(view: View, file: DepthFile, shape: Sequence[int]) -> bool:
    """Whether the shape of a map (height, width) does not tell of which photograph it is."""
    return lens_in(view, file, shape, straight=False) is not None and lens_in(view, file, shape, straight=True) is None


def judge(data: Data, scene: Scene, maps: Mapping[str, DepthFile], tracks: Observations) -> Verdict:
    """Of which photographs the maps are, by name, whose shape fits both: as the user says, or else as fits the sparse
    points better; of the distorted ones where nothing tells."""
    if data.depth_of is not None:
        return Verdict(data.depth_of == "undistorted", "user")
    views = [v for v in scene.train if v.lens is not None and v.name in maps and not maps[v.name].straight]
    chosen = views[:: max(1, -(-len(views) // COMPARED_MAPS))]
    with ThreadPoolExecutor(4) as pool:
        votes = list(pool.map(lambda view: _votes(view, maps[view.name], tracks, scene), chosen))
    undistorted, of_distorted = (sum(vote[side] for vote in votes) for side in (0, 1))
    count = undistorted + of_distorted
    most = max(undistorted, of_distorted)
    if most < MIN_FIT_SHARE * count or abs(undistorted - of_distorted) <= MIN_MAJORITY_SIGMAS * np.sqrt(count):
        return Verdict()
    return Verdict(undistorted > of_distorted, "points")


def _votes(view: View, file: DepthFile, tracks: Observations, scene: Scene) -> tuple[int, int]:
    """How many sparse points a map fits better where the undistorted photograph shows them, and where the distorted
    one does; each time scaled to fit as well as it can, as its unit is another question."""
    try:
        values = file.read()
        if view.lens is None or not fits_both(view, file, values.shape):
            return 0, 0
        at, inverse, _ = points_in(view, tracks, scene, guess=file.aligned)
        bent = distorted(at, view.lens)
        moved = np.linalg.norm((bent - at) * values.shape[::-1], axis=1) > MIN_SHIFT_PX
        off = [_off(sample(values, spots), inverse)[moved] for spots in (at, bent)]
    except BadInput:  # told when it is used
        return 0, 0
    return int((off[0] < off[1]).sum()), int((off[1] < off[0]).sum())


def _off(values: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """(K,) how far values of a map are from inverse depths of points, after alignment; NaN where there is none."""
    scale, offset = align(values, inverse)
    return np.abs(scale * values + offset - inverse)
