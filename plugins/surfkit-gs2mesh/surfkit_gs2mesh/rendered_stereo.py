"""The mesher: stereo on a rendered pair for every training view, fused."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from surfkit.depth.patch_match import PatchMatch
from surfkit.mesh.fusion import TILES_PATTERN
from surfkit.mesh.stereo import points
from surfkit.plugin import (
    TSDF,
    BadInput,
    DepthEstimator,
    Maps,
    Mesh,
    Mesher,
    MeshInput,
    Progress,
    View,
    choice,
    emit,
    name_of,
)
from surfkit_gs2mesh.pair import Pair, estimate

OPAQUE = 0.5
"""Pixels of a lower alpha show no surface that stereo could find."""


@dataclass(frozen=True)
class RenderedStereo(Mesher):
    """Fuse depth that stereo finds in pairs of rendered pictures (GS2Mesh, Wolf et al. 2024).

    Each training view gets a partner to its right. A surface that looks right from both places is found where it looks
    to be, even where the splats themselves are off. The method of the paper uses a stereo network; here any aligned
    depth estimator can be used.
    """

    baseline: float = 0.07
    """Distance between the two views of a pair, as a share of the scene extent."""

    nearest: float = 4.0
    """Least depth that is kept, in baselines: nearer pixels move too far for stereo."""

    farthest: float = 20.0
    """Greatest depth that is kept, in baselines: what lies farther hardly moves."""

    tolerance_px: float = 3.0
    """Largest difference of the disparities of the two pictures, pixels (left-right check)."""

    # A jump of 1 % in depth, where the estimator cuts edges by default, is less than the noise of so short a baseline.
    estimator: Annotated[DepthEstimator, choice(DepthEstimator)] = PatchMatch(tolerance_px=3.0, edge=0.1)
    """The stereo method. It is given the two pictures as a data set of two photographs."""

    fusion: TSDF = field(default_factory=TSDF)
    """How the depth maps are fused."""

    def __post_init__(self) -> None:
        if not 0 < self.baseline <= 10:
            raise BadInput(f"mesh.baseline is {self.baseline:g}; give more than 0 and at most 10 scene extents")
        if not 0 < self.nearest < self.farthest <= 10_000:
            raise BadInput(
                f"mesh.nearest is {self.nearest:g} and farthest {self.farthest:g} baselines; give two numbers above 0, "
                "the second one larger and at most 10000"
            )
        if not 0 < self.tolerance_px <= 1000:
            raise BadInput(f"mesh.tolerance_px is {self.tolerance_px:g}; give more than 0 and at most 1000 pixels")
        if not self.estimator.aligned:
            raise BadInput(
                f"mesh.estimator is {name_of(self.estimator)}, whose depth has no scale; choose one that compares "
                "pictures, such as mesh.estimator:patch-match or mesh.estimator:plane-sweep"
            )

    def ready(self) -> None:
        """See `Mesher.ready`."""
        self.estimator.refuse_unfit(())

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        if not subject.views:
            raise BadInput("nothing to mesh: there are no views")
        self.estimator.refuse_unfit(subject.views)
        with tempfile.TemporaryDirectory(dir=subject.scratch, prefix=TILES_PATTERN.rstrip("*")) as name:
            folder = Path(name)
            kept = [self._stored(subject, at, folder) for at in range(len(subject.views))]
            if not any(kept):
                raise BadInput(
                    f"stereo found no depth from {self.nearest:g} to {self.farthest:g} baselines in any of "
                    f"{len(kept)} views; change --mesh.baseline ({self.baseline:g} scene extents) so that the scene "
                    "lies in this range"
                )
            places = {view.name: at for at, view in enumerate(subject.views)}

            def draw(view: View) -> Maps:
                return stored(folder / f"{places[view.name]}.npz")

            seen = replace(subject, draw=draw, draw_of=None, splats=points(subject.views, draw))
            mesh = self.fusion.mesh(seen)
        return replace(mesh, facts={**mesh.facts, "share_with_stereo_depth": float(np.mean(kept))})

    def _stored(self, subject: MeshInput, at: int, folder: Path) -> float:
        """Write what stereo finds in a view to the folder; the share of the pixels that has a depth."""
        view = subject.views[at]
        pair = Pair(view.camera, self.baseline, self.nearest, self.farthest)
        maps, partner = (subject.draw(replace(view, camera=camera)) for camera in pair.cameras)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            pictures = (maps.need("color"), partner.need("color"))
            found = estimate(pair, pictures, self.estimator, self.tolerance_px, Path(work))
        depth = torch.where(maps.need("alpha") >= OPAQUE, found.depth, 0.0)
        normal: dict[str, Any] = {} if found.normal is None else {"normal": found.normal.numpy()}
        color = (maps.need("color").clamp(0, 1) * 255).round().to(torch.uint8)
        np.savez(folder / f"{at}.npz", depth=depth.numpy(), color=color.numpy(), **normal)
        emit(Progress("stereo on rendered pairs", at + 1, len(subject.views)))
        return float((depth > 0).double().mean())


def stored(path: Path) -> Maps:
    """What a view sees by stereo, from its file."""
    with np.load(path) as file:
        arrays = {name: torch.from_numpy(file[name]) for name in file.files}
    depth = arrays["depth"]
    return Maps(arrays["color"].float() / 255, (depth > 0).float(), depth, depth, arrays.get("normal"))
