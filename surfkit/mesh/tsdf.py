"""Fusion of depth maps into signed distances, and their zero as the surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.registry import choice
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.cuda import gpu_grid as gpu
from surfkit.mesh.fusion import FusionTask, fuse
from surfkit.mesh.fusion_image import Which, depth_of, picture, weighed
from surfkit.mesh.fusion_lengths import MIN_TRUNCATION_VOXELS, Lengths, resolve, with_unit, without_hidden
from surfkit.mesh.grid_tiles import (
    BLOCK_TRIANGLES,
    GRID_BUDGET_SHARE,
    GRID_BYTES,
    MESH_BYTES,
    GridEstimate,
    estimate,
    plan,
)
from surfkit.mesh.lattice import BLOCK_SIDE_VOXELS, FULL_WEIGHT, MAX_BLOCKS_FROM_ORIGIN, FusionImage, Lattice
from surfkit.mesh.oversampling import oversampled
from surfkit.mesh.oversized import without_oversized
from surfkit.mesh.sky import may_show_sky, without_sky
from surfkit.mesh.trust import Trust
from surfkit.scene.lengths import Length, check_length, to_local
from surfkit.scene.scene import Frame, View
from surfkit.scene.up_direction import up_of_views

MIN_MEMORY_BYTES = 50_000_000
"""With less memory, tiles would be smaller than what a view sees of a wall."""
AUTO_TRIANGLES = 20_000_000
"""About as many as an automatic voxel gives at most."""


@dataclass(frozen=True)
class TSDF(Mesher):
    """Fuse the depth of every training view into a grid of signed distances (Curless and Levoy 1996; KinectFusion).

    Distances are to the plane that a pixel shows, by its normal (projective point-to-plane, Bylow et al. 2013): along
    the ray, a surface seen from the side would be a thin shell with holes.
    """

    voxel: Length = "auto"
    """Voxel size, metres; auto is `voxel_px` pixels at the median depth, larger where there would be more than about
    twenty million triangles."""

    truncation: Length = "auto"
    """Truncation distance, metres; auto is `truncation_voxels` voxels. Walls thinner than this may get lost."""

    truncation_voxels: float = 4.0
    """Truncation distance in voxels where it is auto: a smaller one averages less noise, but separates surfaces that
    lie close together."""

    voxel_px: float = 1.0
    """Voxel size in pixels at the median depth where it is auto: smaller ones separate surfaces that lie close
    together, and give more triangles. A pixel larger than a voxel counts by the inverse of its area, so lower
    `least_views` with them."""

    depth_limit: Length = "auto"
    """Depth beyond which pixels are not fused, metres; auto is twice the median depth, or more where more than a
    fiftieth of the pixels lies beyond, as along a street."""

    depth: Which = "median"
    """Depth of a pixel: median is that of the splat where the accumulated opacity reaches 0.5, expected the mean of
    all."""

    oversampling: float = 1.0
    """Pixels of a depth map that is fused, for each pixel in a row of the photograph: more follow edges, and surfaces
    seen from the side, more closely. Drawing, comparing and fusing take as many times more time, squared. Depth maps
    get no longer than 4,096 pixels by it."""

    carve: bool = True
    """Free-space carving: pixels also count as free space in front of their truncation band, which removes floaters."""

    least_views: float = 1.0
    """Sum of the weights of the views that must have seen a voxel; a view at a grazing angle or from far away weighs
    less than one."""

    largest_px: float = 0.0
    """Leave out splats with a larger standard deviation, in pixels at the median depth: they paint places that few
    views see, and hide the surface behind them. 0 keeps all."""

    sky: bool = True
    """Fuse the sky too. Off: what lies above the horizon is left out if depth priors know nothing there, nor above it;
    which way is up, the cameras tell. Views without a depth prior keep theirs. Splats paint the sky at any distance,
    and views agree on it."""

    floaters: float = 0.0
    """Drop connected components that views see through more than this many times as often as they see them; 0 keeps
    all. Without `trust` every view is rendered once more for it."""

    trust: Annotated[Trust | None, choice(Trust, optional=True)] = None
    """Weight of each pixel, in addition to its angle and size; none weighs all alike."""

    def __post_init__(self) -> None:
        for name in ("voxel", "truncation", "depth_limit"):
            check_length(f"mesh.{name}", getattr(self, name))
        if not 0.1 <= self.voxel_px <= 100:
            raise BadInput(f"mesh.voxel_px is {self.voxel_px:g}; it must be from 0.1 to 100")
        if not MIN_TRUNCATION_VOXELS <= self.truncation_voxels <= 100:
            raise BadInput(
                f"mesh.truncation_voxels is {self.truncation_voxels:g}; it must be from {MIN_TRUNCATION_VOXELS:g} to "
                f"100"
            )
        if not 0.1 <= self.oversampling <= 8:
            raise BadInput(f"mesh.oversampling is {self.oversampling:g}; it must be from 0.1 to 8")
        if not 0 <= self.largest_px < float("inf"):
            raise BadInput(f"mesh.largest_px is {self.largest_px:g}; it must be 0 or more")
        if not 0 <= self.floaters <= 1000:
            raise BadInput(f"mesh.floaters is {self.floaters:g}; it must be from 0 to 1000")
        if not 0 < self.least_views <= 1000:
            raise BadInput(f"mesh.least_views is {self.least_views:g}; it must be more than 0 and at most 1000")

    @property
    def needs_prior(self) -> bool:
        """See `Mesher.needs_prior`."""
        return not self.sky or self._trusts_prior

    @property
    def most_triangles(self) -> int | None:
        """See `Mesher.most_triangles`."""
        return AUTO_TRIANGLES if self.voxel == "auto" else None

    def needs_prior_of(self, views: Sequence[View], frame: Frame) -> bool:
        """See `Mesher.needs_prior_of`."""
        return self._trusts_prior or (not self.sky and may_show_sky(views, up_of_views(views, frame)))

    @property
    def _trusts_prior(self) -> bool:
        return self.trust is not None and self.trust.needs_prior

    def refuse_unfit(self, frame: Frame) -> None:
        """See `Mesher.refuse_unfit`."""
        for name in ("voxel", "truncation", "depth_limit"):
            to_local(getattr(self, name), frame, f"mesh.{name}: ")

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        if not len(subject.splats) or not subject.views:
            raise BadInput("nothing to mesh: there are no splats or no views")
        if subject.budget_bytes < MIN_MEMORY_BYTES:
            raise BadInput(
                f"{subject.budget_bytes / 1e6:.0f} MB are too little to mesh in; give --memory "
                f"{MIN_MEMORY_BYTES // 10**6}MB or more"
            )
        given = len(subject.splats)
        if not self.sky:
            subject = without_sky(subject)
        if self.largest_px:
            subject = without_oversized(subject, self.largest_px, self.depth)
        lengths, found = self._lengths(subject)
        subject = oversampled(subject, self.oversampling)
        device = subject.rasterizer.where()
        most_blocks = max(int(GRID_BUDGET_SHARE * subject.budget_bytes / GRID_BYTES), 64)
        if device.type == "cuda":
            most_blocks = min(most_blocks, gpu.most_blocks(device))
        lattice = Lattice(lengths.voxel, lengths.truncation, most_blocks=most_blocks)
        cameras = tuple(view.camera for view in subject.views)
        least = max(1, round(FULL_WEIGHT * self.least_views))
        label = f"fusing views, {describe_lengths(lengths, subject)}"
        compare = None if self.trust is None else self.trust.among
        see = self._eyes(subject, lengths)
        how = lengths.limit, self.carve, least, subject.scratch, label, compare, self.floaters
        task = FusionTask(lattice, cameras, see, *how, device=device)
        (vertices, faces, colors), counts = fuse(task, plan(found, most_blocks))
        left_out = {"oversized_splats": given - len(subject.splats)} if self.largest_px else {}
        if not len(faces):
            raise BadInput(
                f"no surface: with {describe_lengths(lengths, subject)}, no two voxels side by side have the weight of "
                f"--mesh.least-views {self.least_views:g}; lower it, or train for more steps"
            )
        return Mesh(vertices, faces, colors, facts(lengths, subject) | counts | left_out)

    def _eyes(self, subject: MeshInput, lengths: Lengths) -> Callable[[int], FusionImage]:
        """What gives what the view at a position sees."""

        def see(at: int) -> FusionImage:
            view = subject.views[at]
            maps = subject.draw(view)
            depth = depth_of(maps, self.depth)
            depth = torch.where(depth <= lengths.limit, depth, 0.0)
            if (keep := subject.keep(at)) is not None:
                depth = torch.where(keep, depth, 0.0)
            if self.trust is None:
                return picture(depth, maps, view.camera, lengths.voxel, lengths.truncation)
            prior = subject.priors[at] if self._trusts_prior and subject.priors is not None else None
            trust = self.trust.within(maps, depth, prior)
            seen = picture(torch.where(trust > 0, depth, 0.0), maps, view.camera, lengths.voxel, lengths.truncation)
            return replace(seen, shade=weighed(seen.shade, trust.numpy()))

        return see

    def _lengths(self, subject: MeshInput) -> tuple[Lengths, GridEstimate]:
        """What the lengths come to, and how many blocks that takes; BadInput if it is more than can be."""
        given = self.voxel, self.truncation, self.depth_limit
        lengths = resolve(*given, subject, self.depth, self.voxel_px, self.truncation_voxels)
        centres = torch.stack([view.camera.centre for view in subject.views]).numpy()
        within = centres.min(0) - lengths.limit, centres.max(0) + lengths.limit
        splats, found = subject.splats, estimate(subject.splats, lengths.voxel, within)
        most = min(round(AUTO_TRIANGLES / BLOCK_TRIANGLES), for_mesh(subject) // MESH_BYTES)
        if found.total > most:
            splats = without_hidden(subject, self.depth)
            found = estimate(splats, lengths.voxel, within)
        if self.voxel == "auto" and found.total > most:
            emit(
                Warned(
                    f"voxels of {self.voxel_px:g} px, {with_unit(lengths.voxel, subject.frame)}, would give about "
                    f"{found.total * BLOCK_TRIANGLES / 1e6:.0f} million triangles: they are made larger"
                )
            )
        while self.voxel == "auto" and found.total > most:
            coarser = lengths.voxel * max(1.05, (found.total / most) ** 0.5)
            auto = self.truncation == "auto"
            cut = self.truncation_voxels * coarser if auto else max(lengths.truncation, MIN_TRUNCATION_VOXELS * coarser)
            lengths = Lengths(coarser, cut, lengths.limit)
            found = estimate(splats, coarser, within)
        refuse_too_fine(lengths, subject, np.abs(within).max())
        refuse_too_large(lengths, subject, found.total)
        return lengths, found


def describe_lengths(lengths: Lengths, subject: MeshInput) -> str:
    """The lengths as text."""
    voxel, cut, far = (with_unit(value, subject.frame) for value in (lengths.voxel, lengths.truncation, lengths.limit))
    return f"voxels of {voxel}, truncation {cut}, depth up to {far}"


def facts(lengths: Lengths, subject: MeshInput) -> dict[str, Any]:
    """The lengths for mesh.json, in units of the data set and in metres where they are known."""
    values = {"voxel": lengths.voxel, "truncation": lengths.truncation, "depth_limit": lengths.limit}
    metres = subject.frame.local_metres
    found = {name: value / subject.frame.scale for name, value in values.items()}
    return found | ({f"{name}_m": value * metres for name, value in values.items()} if metres else {})


def refuse_too_fine(lengths: Lengths, subject: MeshInput, farthest: float) -> None:
    """BadInput if the voxels cannot be numbered."""
    blocks = farthest / (lengths.voxel * BLOCK_SIDE_VOXELS)
    if blocks > MAX_BLOCKS_FROM_ORIGIN - 2:
        least = farthest / ((MAX_BLOCKS_FROM_ORIGIN - 2) * BLOCK_SIDE_VOXELS)
        raise BadInput(
            f"mesh.voxel is {with_unit(lengths.voxel, subject.frame)}, too small for a scene of "
            f"{with_unit(2 * farthest, subject.frame)}; give {with_unit(1.01 * least, subject.frame)} or more, or a "
            "lower --mesh.depth-limit"
        )


def for_mesh(subject: MeshInput) -> int:
    """Bytes of the budget that are not the grid's."""
    return int((1 - GRID_BUDGET_SHARE) * subject.budget_bytes)


def refuse_too_large(lengths: Lengths, subject: MeshInput, blocks: int) -> None:
    """BadInput if the triangles alone would not fit into the memory."""
    needed, most = blocks * MESH_BYTES, for_mesh(subject)
    if needed > most:
        least = lengths.voxel * (needed / most) ** 0.5
        raise BadInput(
            f"voxels of {with_unit(lengths.voxel, subject.frame)} give about {blocks * BLOCK_TRIANGLES / 1e6:.0f} "
            f"million triangles, which take {needed / 1e9:.1f} GB, and {most / 1e9:.1f} GB may be used; give "
            f"--mesh.voxel {with_unit(1.1 * least, subject.frame)} or more, a lower --mesh.depth-limit, or more "
            "--memory"
        )
