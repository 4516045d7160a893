"""Where points begin: at the sparse cloud, as large as the gaps between its points."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.primitives.columns import Column
from surfkit.primitives.points import Columns
from surfkit.scene.scene import SparsePoints

SH_C0 = 0.28209479177387814
"""Value of the constant spherical harmonic."""
DEFAULT_OPACITY = 0.1
"""Opacity of a new point, where its cloud names none."""
MIN_POINT_SIZE = 1e-5
"""Smallest size of a new point, local units: 1 cm in a scene of 1 km."""
LONE_POINT_SIZE = 0.01
"""Size of a new point without neighbours, local units."""


def seeds(columns: Mapping[str, Column], cloud: SparsePoints) -> Columns:
    """The standard raw columns but the rotations: one point per cloud point, round, of its colour and opacity.

    Args:
        columns: What the primitive declares. Of "means", "scales", "opacities", "sh0" and "sh_rest" those are made that
            it has, by its activations.
        cloud: N points.
    """
    count = len(cloud.xyz)
    if count == 0:
        raise BadInput("the scene has no sparse points to start from; triangulate some (COLMAP point_triangulator)")
    sizes = gaps(cloud.xyz) if cloud.size is None else cloud.size.float().clamp_min(MIN_POINT_SIZE)
    opacities = (
        torch.full((count,), DEFAULT_OPACITY, dtype=torch.float64) if cloud.opacity is None else cloud.opacity.float()
    )
    activated = {
        "means": cloud.xyz.float().clone(),
        "scales": sizes,
        "opacities": opacities,
        "sh0": (cloud.rgb.float() / 255 - 0.5) / SH_C0,
        "sh_rest": torch.zeros(count, 1, 3),
    }
    return {
        name: _spread(column.activation.inverse(activated[name]).float(), column.of_point)
        for name, column in columns.items()
        if name in activated
    }


def _spread(values: Tensor, shape: tuple[int, ...]) -> Tensor:
    """(N, *shape), the same values for all that has none of its own."""
    missing = len(shape) + 1 - values.dim()
    return values.reshape(len(values), *[1] * missing, *values.shape[1:]).expand(-1, *shape).contiguous().clone()


def gaps(xyz: Tensor) -> Tensor:
    """(N,) root mean square distance to the 3 nearest points at other places, local units, at least SMALLEST."""
    from scipy.spatial import cKDTree

    if not len(xyz):
        return torch.zeros(0)
    places, back = np.unique(xyz.double().cpu().numpy(), axis=0, return_inverse=True)
    near = min(3, len(places) - 1)
    if near == 0:
        return torch.full((len(xyz),), LONE_POINT_SIZE)
    distances, _ = cKDTree(places).query(places, k=near + 1)
    sizes = np.sqrt((distances[:, 1:] ** 2).mean(axis=1))
    return torch.from_numpy(sizes[back.reshape(-1)]).float().clamp_min(MIN_POINT_SIZE)


def facing(normals: Tensor) -> Tensor:
    """(N, 4) quaternions wxyz that turn the z axis to unit normals (N, 3)."""
    x, y, z = normals.unbind(-1)
    turn = torch.stack([1 + z, -y, x, torch.zeros_like(x)], dim=-1)
    flipped = normals.new_tensor([0.0, 1.0, 0.0, 0.0])  # half a turn about x where the normal is -z
    return torch.where((z > -1 + 1e-6)[:, None], turn, flipped)
