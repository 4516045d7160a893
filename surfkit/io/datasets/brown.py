"""Brown's lens, as photogrammetry programs have it, and the camera of COLMAP that shows all in the same pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.camera_files import MAX_CAMERA_NUMBER
from surfkit.io.datasets.raw_dataset import camera_of

GRID_SAMPLES_PER_SIDE = 41
"""Points along each side of the grid on which a camera is compared with the lens."""
QUIET_DIFFERENCE_PX, MAX_DIFFERENCE_PX = 0.1, 0.5
"""Differences between both that are not told of, and the largest that is accepted, pixels."""
MAX_RAY_TANGENT = 10.0
"""Rays farther than this from the axis, as x / z, are not looked at."""


@dataclass(frozen=True)
class Brown:
    """A lens: the point (x, y, 1) of the camera frame (x right, y down, z forward) lies at the pixel

        u = cx + fx x' + shear y',    v = cy + fy y',    with r^2 = x^2 + y^2 and
        x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + (2 p1 x y + p2 (r^2 + 2 x^2)) (1 + p3 r^2 + p4 r^4)
        y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + (p1 (r^2 + 2 y^2) + 2 p2 x y) (1 + p3 r^2 + p4 r^4)

    In a fisheye, (x, y) is first brought to the length of its angle to the axis. p1 and p2 are in OpenCV's order:
    programs differ in it.

    Attributes:
        size: Width and height, pixels.
        focal: fx and fy, pixels.
        centre: cx and cy, pixels from the corner of the picture: that of its first pixel is at 0.5.
        radial: k1 to k4.
        tangential: p1 and p2.
        higher: p3 and p4.
        shear: Pixels.
        fisheye: Whether angles are equidistant.
    """

    size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    higher: tuple[float, float] = (0.0, 0.0)
    shear: float = 0.0
    fisheye: bool = False

    def pixels(self, xy: np.ndarray) -> np.ndarray:
        """(N, 2) float64 pixels of (N, 2) points (x, y, 1)."""
        if self.fisheye:
            length = np.linalg.norm(xy, axis=1, keepdims=True)
            xy = xy * np.arctan(length) / np.maximum(length, 1e-12)
        x, y = xy.T
        s = x * x + y * y
        swell, (p1, p2) = self._swell(s), self.tangential
        more = 1 + s * (self.higher[0] + s * self.higher[1])
        u = x * swell + (2 * p1 * x * y + p2 * (s + 2 * x * x)) * more
        v = y * swell + (p1 * (s + 2 * y * y) + 2 * p2 * x * y) * more
        return np.stack([self.focal[0] * u + self.shear * v, self.focal[1] * v], 1) + self.centre

    def camera(self, where: str) -> tuple[Any, float]:
        """The pycolmap camera, and by how many pixels it shows something elsewhere than the lens.

        Args:
            where: The numbers come from, for messages.

        Raises:
            BadInput: There is no such lens, or none of COLMAP's is like it.
        """
        values = [*self.focal, *self.centre, *self.radial, *self.tangential, *self.higher, self.shear]
        if not (all(abs(value) < MAX_CAMERA_NUMBER for value in values) and min(*self.size, *self.focal) > 0):
            shown = ", ".join(f"{value:g}" for value in values)
            raise BadInput(f"{where}: no lens has size {self.size[0]} x {self.size[1]} and parameters {shown}")
        (k1, k2, k3, k4), (p1, p2), reach = self.radial, self.tangential, self._reach()
        if self.fisheye:
            model, extra = "OPENCV_FISHEYE", [k1, k2, k3, k4]
            if p1 or p2:
                model, extra = "THIN_PRISM_FISHEYE", [k1, k2, p1, p2, k3, k4, 0, 0]
        elif any((*self.radial, *self.tangential)):
            first, last = self._rational(reach) if k4 else ((k1, k2, k3), (0.0, 0.0, 0.0))
            model, extra = "FULL_OPENCV", [first[0], first[1], p1, p2, first[2], *last]
        else:
            model, extra = "PINHOLE", []
        made = camera_of(where, model, self.size, [*self.focal, *self.centre, *extra])
        off = self._off(made, reach) if self.lost else 0.0
        if not off <= MAX_DIFFERENCE_PX:
            raise BadInput(
                f"{where}: no camera model of COLMAP has its {self.lost}: without, pixels are up to {off:.2g} off; "
                "optimise the cameras without it, or use undistorted photographs"
            )
        return made, off

    @property
    def lost(self) -> str:
        """What of it COLMAP's models have not, or only nearly; "" where they have all."""
        names = {"k4": self.radial[3] and not self.fisheye, "skew": self.shear, "p3 or p4": any(self.higher)}
        return ", ".join(name for name, value in names.items() if value)

    def _swell(self, s: np.ndarray) -> np.ndarray:
        k1, k2, k3, k4 = self.radial
        return 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))

    def _reach(self) -> float:
        """How far from the axis, as r, the picture shows something, or the lens folds back."""
        away = np.maximum(np.abs(self.centre), np.abs(np.array(self.size) - self.centre)) / self.focal
        r = np.linspace(0, MAX_RAY_TANGENT, 4001)
        bent = (np.arctan(r) if self.fisheye else r) * self._swell((np.arctan(r) if self.fisheye else r) ** 2)
        ends = np.flatnonzero((bent[1:] > np.linalg.norm(away)) | (np.diff(bent) <= 0))
        return float(r[ends[0] + 1] if len(ends) else MAX_RAY_TANGENT)

    def _rational(self, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of (1 + a1 s + a2 s^2 + a3 s^3) / (1 + b1 s + b2 s^2 + b3 s^3), which is nearest to the radial
        polynomial in s = r^2 within the picture: COLMAP has no term of r^8."""
        r = np.linspace(0, 1, 400)
        powers, swell = np.stack([r**2, r**4, r**6], 1), self._swell((r * reach) ** 2)
        weight = (r**2)[:, None]  # evens out how far pixels are moved, from the middle to the corners
        rows = np.hstack([powers, -swell[:, None] * powers]) * weight
        found = np.linalg.lstsq(rows, (swell - 1) * weight[:, 0], rcond=1e-14)[0]
        found /= np.tile(reach ** np.array([2.0, 4.0, 6.0]), 2)
        return found[:3], found[3:]

    def _off(self, made: Any, reach: float) -> float:
        """The largest distance between a pixel of a camera and that of the lens."""
        side = np.linspace(-reach, reach, GRID_SAMPLES_PER_SIDE)
        xy = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
        true = self.pixels(xy)
        shown = (np.linalg.norm(xy, axis=1) <= reach) & ((true >= 0) & (true <= self.size)).all(1)
        got = np.asarray(made.img_from_cam(np.column_stack([xy[shown], np.ones(shown.sum())])))
        return float(np.linalg.norm(got - true[shown], axis=1).max(initial=0))


class LensTable:
    """The cameras of the lenses of a data set: one for all equal ones, and one line for all that they lose."""

    def __init__(self, path: Path):
        """Of the file at `path`."""
        self._path = path
        self._made: dict[Brown, tuple[Any, float]] = {}

    def camera(self, where: str, lens: Brown) -> Any:
        """The pycolmap camera of a lens, or BadInput that names `where` it comes from."""
        if lens not in self._made:
            self._made[lens] = lens.camera(where)
        return self._made[lens][0]

    def tell(self) -> None:
        """Say what the cameras lose, where that moves pixels."""
        moved = {lens: off for lens, (_, off) in self._made.items() if off > QUIET_DIFFERENCE_PX}
        if moved:
            worst = max(moved, key=lambda lens: moved[lens])
            count = f"{len(moved)} of {len(self._made)} lenses"
            emit(
                Warned(
                    f"{self._path}: {count} have terms that no camera model of COLMAP has ({worst.lost}): "
                    f"pixels are up to {moved[worst]:.2f} off"
                )
            )
