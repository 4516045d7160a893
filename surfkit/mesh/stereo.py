"""The stereo depth maps of a data set alone, fused: the baseline of every trained surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Maps, Splats
from surfkit.scene.scene import Frame, View

SAMPLED_MAP_POINTS = 2_000_000
"""About as many points of the maps tell where the surface lies, and so how much memory it takes."""


@dataclass(frozen=True)
class Stereo(Mesher):
    """Fuse the depth priors of the data set, coloured by its photographs; the splats are not used."""

    min_confidence: float = 0.375
    """Least confidence of a pixel that counts; maps without a confidence count everywhere."""

    fusion: TSDF = field(default_factory=TSDF)
    """How the maps are fused."""

    def __post_init__(self) -> None:
        if not 0 < self.min_confidence <= 1:
            raise BadInput(f"mesh.min_confidence is {self.min_confidence:g}; it must be more than 0 and at most 1")

    @property
    def needs_prior(self) -> bool:
        """See `Mesher.needs_prior`."""
        return True

    def refuse_unfit(self, frame: Frame) -> None:
        """See `Mesher.refuse_unfit`."""
        self.fusion.refuse_unfit(frame)

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        priors = subject.priors
        if priors is None:
            raise BadInput(
                "mesh:stereo fuses depth priors, and there are none that can be used; "
                "make some with `surfkit prepare depth DATA`"
            )
        places = {view.name: at for at, view in enumerate(subject.views)}

        def draw(view: View, coloured: bool = True) -> Maps:
            at = places[view.name]
            prior = priors[at]  # there is none of a damaged photograph
            photo = None if prior is None or subject.photo is None or not coloured else subject.photo(at)
            return seen(view, prior, photo, self.min_confidence)

        splats = points(subject.views, lambda view: draw(view, coloured=False))
        if not len(splats):
            raise BadInput(
                f"none of {len(subject.views)} views has a depth prior of confidence {self.min_confidence:g} or more; "
                "lower min_confidence of mesh:stereo, or look at the maps"
            )
        return self.fusion.mesh(replace(subject, draw=draw, draw_of=None, splats=splats))


def seen(view: View, prior: DepthPrior | None, photo: Tensor | None, least: float) -> Maps:
    """What a view sees by its prior; nothing where there is none.

    Args:
        view: Of the prior.
        prior: Its estimated depth.
        photo: (3, H, W) uint8 that gives the colours; grey without one.
        least: Confidence of a pixel that counts.
    """
    height, width = view.camera.height, view.camera.width
    color = torch.full((3, height, width), 0.5) if photo is None else photo.float() / 255
    if prior is None:
        nothing = torch.zeros(height, width)
        return Maps(color, nothing, nothing, nothing)
    there = (prior.inverse > 0) & (prior.confidence >= least)
    depth = torch.where(there, 1 / prior.inverse.clamp_min(1e-20), 0.0)
    return Maps(color, there.to(depth.dtype), depth, depth, prior.normal)


def points(views: Sequence[View], draw: Callable[[View], Maps]) -> Splats:
    """Points of the maps, evenly from all views, as splats that tell where the surface is."""
    found = [_points(view, draw(view).need("median"), max(1, SAMPLED_MAP_POINTS // len(views))) for view in views]
    means = torch.cat(found) if found else torch.empty(0, 3)
    count = len(means)
    one = torch.ones(count, 4)
    return Splats("surfel", means, one, one[:, :2], one[:, 0], torch.zeros(count, 1, 3))


def _points(view: View, depth: Tensor, most: int) -> Tensor:
    """(P, 3) float32 local positions of some of the pixels of a depth map."""
    camera = view.camera
    rows, columns = torch.nonzero(depth > 0, as_tuple=True)
    step = max(1, -(-len(rows) // most))
    rows, columns = rows[::step], columns[::step]
    z = depth[rows, columns].double()
    x, y = (columns + 0.5 - camera.cx) / camera.fx * z, (rows + 0.5 - camera.cy) / camera.fy * z
    pose = camera.world_to_camera
    return ((torch.stack([x, y, z], 1) - pose[:3, 3]) @ pose[:3, :3]).float()
