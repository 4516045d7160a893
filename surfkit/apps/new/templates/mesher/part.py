"""Another mesher, and smooth triangles of what it makes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from scipy.sparse import coo_array
from surfkit.plugin import BadInput, Mesh, MeshInput, Mesher, TSDF, choice


@dataclass(frozen=True)
class NewPart(Mesher):
    """Smooth the triangles of another mesher without shrinking them (Taubin 1995)."""

    passes: int = 5
    """Times that the vertices are smoothed; 0 leaves them as they are."""

    inner: Annotated[Mesher, choice(Mesher, without=("new-part",))] = TSDF()
    """The mesher that makes the triangles."""

    def __post_init__(self) -> None:
        if self.passes < 0:
            raise BadInput(f"new-part.passes is {self.passes}; it must be 0 or more")

    @property
    def needs_prior(self) -> bool:
        """See `Mesher.needs_prior`."""
        return self.inner.needs_prior

    def ready(self) -> None:
        """See `Mesher.ready`."""
        self.inner.ready()

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        mesh = self.inner.mesh(subject)
        vertices = smoothed(mesh.vertices, mesh.faces, self.passes)
        return replace(mesh, vertices=vertices, facts={**mesh.facts, "smoothing_passes": self.passes})


def smoothed(vertices: np.ndarray, faces: np.ndarray, passes: int) -> np.ndarray:
    """(V, 3) float32 vertices moved towards the mean of their neighbours, then away from it, `passes` times."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.unique(np.concatenate([ends, ends[:, ::-1]]), axis=0)
    neighbours = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(vertices),) * 2).tocsr()
    count = np.bincount(ends[:, 0], minlength=len(vertices))[:, None]
    moved = vertices.astype(np.float64)
    for _ in range(passes):
        for share in (0.5, -0.53):
            mean = neighbours @ moved / np.maximum(count, 1)
            moved = np.where(count > 0, moved + share * (mean - moved), moved)
    return moved.astype(np.float32)


CHANGE: Mapping[str, Any] = {"mesh": NewPart()}
"""What puts the part into a recipe, by dotted path."""
