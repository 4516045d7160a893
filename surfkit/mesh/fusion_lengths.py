"""Lengths of a mesher in metres or `auto`, and what they are in the local frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.mesh.base import MeshInput
from surfkit.mesh.fusion_image import Which, depth_of
from surfkit.raster.api import Splats
from surfkit.scene.lengths import Length, to_local
from surfkit.scene.scene import Frame

SAMPLED_VIEWS = 16
"""Views that automatic lengths are taken from."""
DEPTH_LIMIT_MEDIANS = 2.0
"""Automatic limit of the depth, in median depths, where hardly anything lies beyond."""
DEPTH_LIMIT_SHARE = 0.98
"""Share of the pixels whose depth is within the automatic limit: photographs along a street show much that is further
than twice the median."""
MAX_DEPTH_OFFSET = 0.03
"""Share of its depth by which a splat may lie off what a view sees there, and be part of it."""
MIN_TRUNCATION_VOXELS = 1.75
"""Least truncation, voxels: the corners of a cell lie up to the root of three from a plane through it."""


@dataclass(frozen=True)
class Lengths:
    """Local units: the side of a voxel, the truncation of distances, and the depth from which nothing is fused."""

    voxel: float
    truncation: float
    limit: float


def resolve(
    voxel: Length,
    truncation: Length,
    limit: Length,
    subject: MeshInput,
    which: Which,
    voxel_px: float,
    truncation_voxels: float,
) -> Lengths:
    """The lengths in local units; automatic ones follow from what the views see, the truncation from the voxel.

    Args:
        voxel: Side of a voxel; if it is auto, `voxel_px` pixels at the median depth.
        truncation: Of distances; if it is auto, `truncation_voxels` voxels.
        limit: Depth from which nothing is fused; if it is auto, `DEPTH_LIMIT_MEDIANS` median depths, or that of the
        share `DEPTH_LIMIT_SHARE`
            of the pixels if it is more.
        subject: What is meshed.
        which: Depth of a pixel.
        voxel_px: See `voxel`.
        truncation_voxels: See `truncation`.

    Raises:
        BadInput: There is no depth in any view, or lengths are in metres and nobody knows how long a unit is.
    """
    size, cut, most = (to_local(value, subject.frame) for value in (voxel, truncation, limit))
    if size is None or most is None:
        depth, pixel, far = look(subject, which)
        size = size or voxel_px * pixel
        most = most or max(DEPTH_LIMIT_MEDIANS * depth, far)
    cut = cut or truncation_voxels * size
    if cut < MIN_TRUNCATION_VOXELS * size:
        raise BadInput(
            f"mesh.truncation is {with_unit(cut, subject.frame)} with voxels of {with_unit(size, subject.frame)}; "
            f"it must be at least {MIN_TRUNCATION_VOXELS:g} voxels"
        )
    return Lengths(size, cut, most)


def with_unit(length: float, frame: Frame) -> str:
    """A local length in metres, or in units of the data set where metres are not known."""
    if frame.local_metres is not None:
        return f"{length * frame.local_metres:.3g} m"
    return f"{length / frame.scale:.3g} units"


def sampled(subject: MeshInput) -> list[int]:
    """Positions of up to `SAMPLED_VIEWS` views, evenly."""
    count = len(subject.views)
    return [at * count // min(SAMPLED_VIEWS, count) for at in range(min(SAMPLED_VIEWS, count))]


def shown(subject: MeshInput, at: int, which: Which) -> Tensor:
    """(H, W) depth that the view at a position shows and that is to be fused, camera z; 0 where there is none."""
    depth, keep = depth_of(subject.draw(subject.views[at]), which), subject.keep(at)
    return depth if keep is None else torch.where(keep, depth, 0.0)


def look(subject: MeshInput, which: Which) -> tuple[float, float, float]:
    """Median over some views of their median depth, of the width of a pixel there, and of all pixels the depth that a
    share of `DEPTH_LIMIT_SHARE` has at most; local units.

    Views without depth are passed over for others.
    """
    count, first = len(subject.views), sampled(subject)
    depths: list[float] = []
    pixels: list[float] = []
    seen: list[Tensor] = []
    for at in [*first, *sorted(set(range(count)) - set(first))]:
        if len(depths) >= len(first) // 2 + 1 and at not in first:
            break
        view = subject.views[at]
        depth = shown(subject, at, which)
        depth = depth[depth > 0]
        if len(depth):
            depths.append(float(depth.median()))
            pixels.append(depths[-1] / min(view.camera.fx, view.camera.fy))
            seen.append(depth)
    if not depths:
        raise BadInput(
            f"no depth in any of {count} views: the splats are not opaque enough to be a surface; train for more steps"
            + (", or try --mesh.depth expected" if which == "median" else "")
        )
    far = np.quantile(torch.cat(seen).numpy(), DEPTH_LIMIT_SHARE)
    return float(np.median(depths)), float(np.median(pixels)), float(far)


def without_hidden(subject: MeshInput, which: Which) -> Splats:
    """The splats without those that some of the sampled views look at and none of them sees, as behind walls.

    These never become a surface. They are many where points begin at depth that nobody trusts.
    """
    means = subject.splats.means.double().cpu()
    looked, seen = torch.zeros(2, len(means), dtype=torch.bool)
    for at in sampled(subject):
        depth, camera = shown(subject, at, which), subject.views[at].camera
        x, y, z = camera.project(means).T
        inside = torch.nonzero((z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))[:, 0]
        found = depth[y[inside].long(), x[inside].long()]
        looked[inside] = True
        seen[inside] |= (found > 0) & ((found / z[inside] - 1).abs() < MAX_DEPTH_OFFSET)
    return subject.splats.take(seen | ~looked)
