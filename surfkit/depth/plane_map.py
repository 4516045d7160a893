"""What PatchMatch finds of one photograph, until it is an estimate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surfkit.core.files import replacing
from surfkit.scene.arrays import write_array
from surfkit.scene.camera import Camera
from surfkit.scene.vectors import unit


@dataclass(frozen=True)
class PlaneMap:
    """The planes of one photograph.

    Attributes:
        value: (H, W, 3) float32, see `Planes`.
        each: (H, W, V) uint8, see `Planes`; of all photographs that this one is compared with.
        parallax: Pixels by which the photographs move that it is compared with, a unit of inverse depth.
    """

    value: np.ndarray
    each: np.ndarray
    parallax: float

    def matched(self, best: int) -> Tensor:
        """(H, W) float32 in [0, 1], how well the best views match."""
        costs = np.sort(self.each, 2)[..., :best].mean(2, dtype=np.float32)
        return torch.from_numpy(1 - costs / 255)

    @property
    def inverse(self) -> Tensor:
        """(H, W) inverse depth."""
        return torch.from_numpy(np.ascontiguousarray(self.value[..., 0]))

    def normals(self, camera: Camera) -> Tensor:
        """(3, H, W) unit normals in the camera's axes, towards it.

        A plane is n . X = 1, so that n . ray is its inverse depth.
        """
        w, gx, gy = torch.from_numpy(self.value).unbind(-1)
        rays = camera.rays()
        nx, ny = gx * camera.fx, gy * camera.fy
        away = torch.stack([nx, ny, w - nx * rays[0] - ny * rays[1]])
        return -unit(away)


def save_map(path: Path, found: PlaneMap | None) -> None:
    """Write a map, or that there is none, into a file: three arrays one after the other, or nothing."""
    with replacing(path) as file:
        for values in (found.value, found.each, np.full(1, found.parallax, np.float32)) if found else ():
            write_array(file, values)


def load_map(path: Path) -> PlaneMap | None:
    """What `save_map` wrote."""
    with path.open("rb") as file:
        if not path.stat().st_size:
            return None
        return PlaneMap(np.load(file), np.load(file), float(np.load(file)[0]))


def inverse_of(found: PlaneMap | None, device: torch.device) -> Tensor | None:
    """(H, W) inverse depth of a map, on a device."""
    return None if found is None else found.inverse.to(device)
