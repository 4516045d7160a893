"""Gaussian splatting in the stages of the recipe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from surfkit.runs.methods.base import Method, MethodInput, Reconstruction


@dataclass(frozen=True)
class SplatOptimisation(Method):
    """Optimise splats as the other fields of the recipe say: pretraining, blocks, refinement, compression, mesh,
    levels of detail."""

    uses: ClassVar[tuple[str, ...]] = (
        "primitive",
        "depth",
        "start",
        "pretrain",
        "partition",
        "partition_pretrain",
        "assign",
        "min_views",
        "tune",
        "context",
        "refine",
        "compress",
        "mesh",
        "lod",
    )

    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """See `Method.reconstruct`."""
        assert given.optimise is not None, "the method uses pretrain"
        return given.optimise()
