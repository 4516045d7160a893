"""The mesh at the end: that of the last step, of all pivots (MILo, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from surfkit.plugin import BadInput, Mesh, Mesher, MeshInput, vertex_colors
from surfkit_milo.pivots import Boxes, crossings, require_pivots, tetrahedra, vertices


@dataclass(frozen=True)
class PivotMesh(Mesher):
    """Marching tetrahedra on the pivots of the Gaussians, with the values that were trained with them (MILo)."""

    longest: float = 1.0
    """Maximum length of an edge that the surface crosses, as a multiple of the half diagonals of the boxes at its ends,
    added up; 0 sets no limit."""

    def __post_init__(self) -> None:
        if not 0 <= self.longest < float("inf"):
            raise BadInput(f"mesh: pivots.longest is {self.longest:g}; give 0 or more")

    @torch.no_grad()
    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        splats = subject.splats
        require_pivots(splats, "mesh:pivots")
        spread = splats.extra["spread"]
        boxes = Boxes.of(splats, spread, (spread > 0).nonzero()[:, 0]).double()
        count = 9 * len(boxes.centres)
        ends = crossings(tetrahedra(boxes.places().view(-1, 3)), boxes, self.longest) if count else ()
        if not len(ends):
            raise BadInput(
                f"mesh: no surface between {count:,} pivots of {len(splats):,} Gaussians; train longer, with "
                "pretrain.regularizers.mesh:mesh-in-the-loop"
            )
        edges, faces = np.unique(np.reshape(ends, (-1, 2)), axis=0, return_inverse=True)
        places = vertices(boxes, torch.from_numpy(edges)).numpy()
        colors = vertex_colors(subject, places)
        facts = {"pivots": count, "gaussians_with_pivots": len(boxes.centres)}
        return Mesh(places.astype(np.float32), faces.reshape(-1, 3).astype(np.int32), colors, facts)
