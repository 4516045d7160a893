"""What a data set is to the rest of surfkit: views, a sparse cloud, and the frame they live in."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.scene.camera import Camera
from surfkit.scene.pixels import DEFAULT_PIXELS, Pixels

EXTENT_FACTOR = 1.1
"""The scene extent is this times the largest distance of a training camera to their mean centre."""
MAX_EXTENTS_OFFSET = 16
"""Beyond this many extents from 0, float32 coordinates would lose what is a millionth of the extent."""
OFFSET_OF_SYSTEM = re.compile(r"(\S+ \S+ \S+) \(add it to x y z to get (.+)\)")
"""An offset in the header of a file, and the coordinate reference system of the coordinates with it."""


@dataclass(frozen=True)
class Lens:
    """A distorted camera as plain values.

    Attributes:
        model: As COLMAP calls it.
        params: As COLMAP orders them.
        width: Of the photographs at the size used, pixels.
        height: The same.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int


@dataclass(frozen=True)
class Mask:
    """What of a photograph is to be ignored.

    Attributes:
        path: A picture on disk; that of the photograph itself where its opacity is the mask.
        alpha: Whether its alpha channel counts: what is opaque is kept. If not, its colours: what is black is ignored.
        is_part: Whether it is of one view of a panorama, of which it may keep nothing.
    """

    path: Path
    alpha: bool = False
    is_part: bool = False


@dataclass(frozen=True)
class View:
    """One photograph and the camera that took it.

    Attributes:
        name: Path of the photograph below the image folder, as the data set spells it.
        camera: At the size used in training.
        path: The photograph on disk.
        mask: Its mask, if it has one.
        white: Whether its transparent pixels lie over white, or over black.
        lens: That of the photograph of which `path` is the undistorted picture; None where nothing was distorted.
        pixels: What the values of the file mean.
        taken_by: Which camera took it: photographs of one camera have the same words here.
    """

    name: str
    camera: Camera
    path: Path
    mask: Mask | None = None
    white: bool = False
    lens: Lens | None = None
    pixels: Pixels = DEFAULT_PIXELS
    taken_by: str = ""


@dataclass(frozen=True)
class SparsePoints:
    """Points that splats begin at: sparse ones from structure from motion, or others.

    Attributes:
        xyz: (P, 3) float32, local frame.
        rgb: (P, 3) uint8.
        normals: (P, 3) float32 unit vectors, or None.
        opacity: (P,) float32 in (0, 1) to begin with; None leaves it to the primitive.
        size: (P,) float32 standard deviation to begin with, local units; None takes the gaps between the points.
        drawn: Whether the points are random ones, as the data set has none.
    """

    xyz: Tensor
    rgb: Tensor
    normals: Tensor | None = None
    opacity: Tensor | None = field(default=None, metadata={"digest": False})  # no part of a data set's fingerprint
    size: Tensor | None = field(default=None, metadata={"digest": False})
    drawn: bool = field(default=False, metadata={"digest": False})


@dataclass(frozen=True)
class Frame:
    """Where the local frame lies in the frame of the input: local = (input - origin) * scale.

    The scale is 1 / E with the scene extent E = 1.1 x the largest distance of a training camera to their mean
    centre, so that in the local frame every setting that is "a share of the extent" is a plain length.

    Attributes:
        origin: (3,) float64, input units.
        scale: Local units per input unit.
        metres: Metres per input unit; None where the data set does not say.
        crs: Coordinate reference system of the input frame, such as "EPSG:32632"; None where there is none.
        shift: What coordinates in files of float32 leave out, input units: file = input - shift. Survey coordinates
            of millions of metres would be half a metre apart otherwise.
    """

    origin: np.ndarray
    scale: float
    metres: float | None = None
    crs: str | None = None
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def around(cls, poses: np.ndarray, points: np.ndarray) -> Frame:
        """The frame of the training cameras; where they stand in one place, the points give the extent.

        Args:
            poses: (V, 4, 4) float64 world_to_camera of the training cameras, input frame.
            points: (P, 3) float64 input units; their median distance replaces that of the cameras.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # what is infinite then is refused below
            centres = -(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0]
            origin = centres.mean(0)
            reach = EXTENT_FACTOR * np.linalg.norm(centres - origin, axis=1).max()
            spread = np.median(np.linalg.norm(points - origin, axis=1)) if len(points) else 0.0
        extent = reach if reach > 1e-6 * spread else spread
        if not 0 < extent < np.inf:
            raise BadInput("all training cameras and points lie in one place; a scene needs views from several places")
        return cls(origin, float(1 / extent), shift=_shift(origin, extent))

    @classmethod
    def of_positions(cls, xyz: np.ndarray) -> Frame:
        """The frame of splats or points whose data set is not known: (N, 3) positions as they are, with a shift where
        they lie far from 0."""
        if not len(xyz):
            return cls(np.zeros(3), 1.0)
        middle = np.median(xyz.astype(np.float64), axis=0)
        extent = float(np.median(np.linalg.norm(xyz - middle, axis=1))) or 1.0
        return cls(np.zeros(3), 1.0, shift=_shift(middle, extent))

    @property
    def local_metres(self) -> float | None:
        """Metres per local unit, or None where the data set does not say."""
        return None if self.metres is None else self.metres / self.scale

    @property
    def comments(self) -> list[str]:
        """What the header of a file in this frame says of it; no line where there is nothing to say.

        MDAL, by which QGIS reads meshes, takes `crs: ...` for the system of the coordinates as they are in the file. So
        where these leave out the offset, its line names the system, and no line begins with `crs:`.
        """
        offset = "offset: " + " ".join(f"{value:.15g}" for value in self.shift)
        stated = [f"crs: {self.crs}"] if self.crs else []
        if any(self.shift):
            stated = [f"{offset} (add it to x y z to get {self.crs})" if self.crs else offset]
        return [
            *stated,
            *([f"metres per unit: {self.metres:.15g}"] if self.metres else []),
        ]

    def to_local(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) float64 local positions of positions in the input frame."""
        return (np.asarray(xyz, np.float64) - self.origin) * self.scale

    def to_input(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) float64 positions in the input frame of local positions."""
        return np.asarray(xyz, np.float64) / self.scale + self.origin

    def to_file(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) float64 coordinates, of local positions, that a file of float32 keeps: without the shift."""
        return np.asarray(xyz, np.float64) / self.scale + (self.origin - self.shift)

    def local_pose(self, pose: np.ndarray) -> Tensor:
        """(4, 4) float64 world_to_camera for `Camera`, of one in the input frame; camera units become local too."""
        local = np.array(pose, np.float64)
        local[:3, 3] = self.scale * (local[:3, :3] @ self.origin + local[:3, 3])
        return torch.from_numpy(local)

    def input_pose(self, pose: Tensor) -> np.ndarray:
        """(4, 4) float64 world_to_camera in the input frame, of a local one."""
        result = pose.to(torch.float64).cpu().numpy().copy()
        result[:3, 3] = result[:3, 3] / self.scale - result[:3, :3] @ self.origin
        return result


@dataclass(frozen=True)
class Scene:
    """A data set, ready for training.

    Attributes:
        name: Of the data folder.
        train: Views to optimise on, in name order.
        held_out: Views to evaluate on, in name order; may be empty.
        cloud: Sparse points.
        frame: From the local frame back to the input's.
    """

    name: str
    train: tuple[View, ...]
    held_out: tuple[View, ...]
    cloud: SparsePoints
    frame: Frame


def offset_of_comment(stated: str) -> tuple[str, str | None]:
    """The three numbers of an offset as `Frame.comments` states it, and the coordinate reference system of coordinates
    with it; None where that is not there."""
    found = OFFSET_OF_SYSTEM.fullmatch(stated)
    return (found[1], found[2]) if found else (stated, None)


def _shift(origin: np.ndarray, extent: float) -> tuple[float, float, float]:
    """A round number near the coordinates of the scene along each axis on which they are far from 0."""
    grain = 10.0 ** np.floor(np.log10(extent))
    east, north, up = (
        float(np.round(at / grain) * grain) if abs(at) > MAX_EXTENTS_OFFSET * extent else 0.0 for at in origin
    )
    return east, north, up
