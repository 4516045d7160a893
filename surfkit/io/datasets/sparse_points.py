"""Where points begin by what the data set has: its sparse points, or random ones in their place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from surfkit.core.events import Warned, emit
from surfkit.io.datasets.panoramas import points_remedy, view_names
from surfkit.io.datasets.raw_dataset import RawDataset
from surfkit.scene.scene import Frame, SparsePoints

RANDOM_POINTS = 50_000
"""Where a data set has no sparse points."""


def sparse_points(path: Path, capture: RawDataset, poses: np.ndarray, frame: Frame) -> SparsePoints:
    """Those of the data set in the local frame; where it has none, random ones, with a warning.

    Args:
        path: Of the data set.
        capture: What was read.
        poses: (V, 4, 4) from the world of the data set to each camera.
        frame: The local frame.
    """
    if len(capture.xyz):
        xyz = frame.to_local(capture.xyz).astype(np.float32)
        return SparsePoints(torch.from_numpy(xyz), torch.from_numpy(capture.rgb))
    emit(
        Warned(
            f"the data set has no sparse points: training starts from {RANDOM_POINTS} random ones in the box of the "
            "cameras and of what lies before them, which takes longer and leaves more floaters; "
            f"{points_remedy(path, view_names(capture.shots))}"
        )
    )
    local = np.stack([frame.local_pose(pose).numpy() for pose in poses])
    centres = -(local[:, :3, :3].transpose(0, 2, 1) @ local[:, :3, 3:])[..., 0]
    corners = np.concatenate([centres, centres + local[:, 2, :3]])  # one extent ahead, along the optical axes
    draw = np.random.default_rng(0)
    xyz = draw.uniform(corners.min(0), corners.max(0), (RANDOM_POINTS, 3)).astype(np.float32)
    return SparsePoints(torch.from_numpy(xyz), torch.full((RANDOM_POINTS, 3), 128, dtype=torch.uint8), drawn=True)
