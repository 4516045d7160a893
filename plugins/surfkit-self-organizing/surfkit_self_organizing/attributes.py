"""What splats are compared by, in a grid (Morgenstern et al. 2024)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from surfkit.plugin import SOG, Splats, SplatTable
from surfkit_self_organizing.plas import sorted_places

SORTED_BY = ("positions", "colors", "scales", "rotations", "opacities")
"""Attributes that the order follows from, all alike; harmonics of higher degrees stand in no picture of a SOG file."""


def attributes_of(splats: Splats) -> dict[str, Tensor]:
    """(N, D) each, by name, with the graph to the splats; in values whose differences are about as visible everywhere.

    positions (N, 3) as they are; colors (N, 3) and harmonics (N, 3 K - 3) coefficients; scales (N, 2) or (N, 3) natural
    logarithms; rotations (N, 4) unit quaternions whose largest component is positive, as q and -q are the same;
    opacities (N, 1).
    """
    return {
        "positions": splats.means,
        "colors": splats.sh0.flatten(1),
        "harmonics": splats.sh_rest.flatten(1),
        "scales": splats.scales.log(),
        "rotations": turned(splats.quats),
        "opacities": splats.opacities[:, None],
    }


def turned(quats: Tensor) -> Tensor:
    """(N, 4) unit quaternions of the same rotations, whose largest component is positive."""
    unit = quats / quats.norm(dim=1, keepdim=True)
    largest = unit.detach().abs().argmax(1, keepdim=True)
    return torch.where(unit.detach().gather(1, largest) < 0, -unit, unit)


def table_attributes(table: SplatTable) -> dict[str, Tensor]:
    """As `attributes_of`, of a table."""
    return {
        "positions": table.means,
        "colors": table.sh0,
        "scales": table.log_scales,
        "rotations": turned(table.quats),
        "opacities": table.opacities[:, None],
    }


def grid_order(attributes: dict[str, Tensor], seed: int) -> np.ndarray:
    """(N,) int64 which splat is at each place of the pictures of a SOG file, row by row: `plas.sorted_places`.

    Of each attribute the median is subtracted, and the mean distance from it is 1 then; splats far outside count by the
    logarithm of that distance (arsinh).
    """
    count = len(attributes["positions"])
    if count == 0:
        return np.zeros(0, np.int64)
    columns = []
    for name in SORTED_BY:
        values = attributes[name].detach().cpu().double().numpy()
        values = values - np.median(values, 0)
        spread = np.abs(values).mean()
        columns.append(np.arcsinh(values / spread) if spread > 0 else values)
    return sorted_places(np.concatenate(columns, 1), SOG.picture_width(count), seed)
