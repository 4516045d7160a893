"""What a data set is to the rest of surfkit: views, a sparse cloud, and the frame they live in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from surfkit.scene.camera import Camera


@dataclass(frozen=True)
class View:
    """One photograph and the camera that took it.

    Attributes:
        name: Path of the photograph below the image folder, as the data set spells it.
        camera: At the size used in training.
        path: The photograph on disk.
    """

    name: str
    camera: Camera
    path: Path


@dataclass(frozen=True)
class Cloud:
    """Sparse points from structure from motion.

    Attributes:
        xyz: (P, 3) float32, local frame.
        rgb: (P, 3) uint8.
        normals: (P, 3) float32 unit vectors, or None.
    """

    xyz: Tensor
    rgb: Tensor
    normals: Tensor | None = None


@dataclass(frozen=True)
class Frame:
    """Where the local frame lies in the frame of the input: local = (input - origin) * scale.

    The scale is 1 / E with the scene extent E = 1.1 x the largest distance of a training camera to their mean
    centre, so that in the local frame every setting that is "a share of the extent" is a plain length.

    Attributes:
        origin: (3,) float64, input units.
        scale: Local units per input unit.
    """

    origin: np.ndarray
    scale: float


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
    cloud: Cloud
    frame: Frame
