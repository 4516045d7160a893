"""Cutting a large scene into blocks, and putting them together again."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.partition.airspace import Airspace
from surfkit.partition.assign import Assign, PictureShare, SSIMDifference
from surfkit.partition.balanced import Balanced
from surfkit.partition.base import Cells, CoarseModel, Partition
from surfkit.partition.camera_grid import CameraGrid
from surfkit.partition.grid import ContractedGrid, QuantileGrid
from surfkit.partition.sparse_points import SparsePointShare
from surfkit.partition.square_grid import SquareGrid


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """What this folder offers."""
    return {
        "contracted-grid": ContractedGrid,
        "quantile-grid": QuantileGrid,
        "camera-grid": CameraGrid,
        "square-grid": SquareGrid,
        "balanced": Balanced,
        "ssim-difference": SSIMDifference,
        "picture-share": PictureShare,
        "airspace": Airspace,
        "sparse-points": SparsePointShare,
    }


__all__ = [
    "Airspace",
    "Assign",
    "Balanced",
    "CameraGrid",
    "Cells",
    "ContractedGrid",
    "Partition",
    "PictureShare",
    "QuantileGrid",
    "SSIMDifference",
    "SparsePoints",
    "SquareGrid",
    "CoarseModel",
]
