"""Splats that are balls."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from surfkit.plugin import (
    SparsePoints,
    Column,
    Columns,
    Gaussian3D,
    Primitive,
    SIGMOID,
    SplatTable,
    Splats,
    harmonics,
    seeds,
    standard_columns,
)


@dataclass(frozen=True)
class NewPart(Primitive):
    """Balls: Gaussians with one scale for all directions, which need no rotation."""

    def columns(self) -> Mapping[str, Column]:
        """Those of 3DGS with a single scale, and without rotations."""
        columns = standard_columns(3, self.sh_degree)
        del columns["quats"]
        return columns | {"scales": Column((1,), columns["scales"].rate, columns["scales"].activation)}

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """A ball for each point of the cloud."""
        return seeds(self.columns(), cloud)

    def activate(self, params: Columns, degree: int) -> Splats:
        """Gaussians with three equal scales."""
        means = params["means"]
        return Splats(
            kind="gaussian",
            means=means,
            quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),
            scales=params["scales"].exp().repeat(1, 3),
            opacities=SIGMOID.value(params["opacities"]),
            sh0=params["sh0"],
            sh_rest=harmonics(params, degree),
        )

    def from_table(self, table: SplatTable, generator: torch.Generator) -> Columns:
        """Balls whose scale is the geometric mean of the splats' scales."""
        params = Gaussian3D(sh_degree=self.sh_degree).from_table(table, generator)
        params["scales"] = table.log_scales.float().mean(1, keepdim=True)
        return {name: params[name] for name in self.columns()}


CHANGE: Mapping[str, Any] = {"primitive": NewPart()}
"""What puts the part into a recipe, by dotted path."""
