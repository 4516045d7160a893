"""The primitive: anchors, each of which stands for k Gaussians or surfels that differ from view to view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.plugin import (
    EXP,
    SIGMOID,
    BadInput,
    Camera,
    Column,
    Columns,
    DerivedRender,
    LearningRate,
    Primitive,
    Rasterizer,
    Render,
    SparsePoints,
    Splats,
    seeds,
)
from surfkit.raster.api import CUTOFF
from surfkit.raster.autograd import summed_by_owner
from surfkit_octree.decode import decode, fresh_networks, network_columns
from surfkit_octree.levels import TABLE, LevelTable, is_in_view

FULL = 9.0
"""Raw opacity factor of a new anchor: 0.9999."""


@dataclass(frozen=True)
class Anchors(Primitive):
    """Anchors of a feature and k offsets: for each view, networks common to all decode them into k Gaussians or surfels
    each (Scaffold-GS, Lu et al. 2024); of several levels of detail, by the distance to the camera (Octree-GS, Ren et
    al. 2024)."""

    in_ply: ClassVar[bool] = False

    sh_degree: int = 0
    """Must be 0: the network that makes colours knows the view direction."""

    draws: Literal["gaussian", "surfel"] = "gaussian"
    """What an anchor is decoded into: ellipsoids (3DGS) or flat discs (2DGS), whose depth and normals are cleaner."""

    feature: int = 32
    """Numbers of the feature of an anchor."""

    offsets: int = 10
    """Gaussians of an anchor (k)."""

    hidden: int = 32
    """Width of the hidden layer of each network."""

    def __post_init__(self) -> None:
        if self.sh_degree != 0:
            raise BadInput(
                f"primitive.sh_degree is {self.sh_degree}; anchors have colours from a network, leave it at 0"
            )
        for name in ("feature", "offsets", "hidden"):
            if not 1 <= getattr(self, name) <= 1024:
                raise BadInput(f"primitive.{name} is {getattr(self, name)}; it must be 1 to 1024")

    def columns(self) -> Mapping[str, Column]:
        """See `Primitive.columns`. Positions, levels and the shared table of levels keep their values in training."""
        fixed = LearningRate(0.0)
        return {
            "means": Column((3,), fixed),
            "scales": Column((6,), LearningRate(7e-3), EXP),
            "opacities": Column((), LearningRate(5e-2), SIGMOID),
            "feature": Column((self.feature,), LearningRate(7.5e-3)),
            "offsets": Column((self.offsets, 3), LearningRate(1e-2, 1e-4)),
            "level": Column((), fixed),
            "extra": Column((), fixed),
            TABLE: Column((5,), fixed, shared=True),
            **network_columns(self.feature, self.hidden, self.offsets),
        }

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """One anchor of level 0 for each cloud point, with a feature and offsets of 0."""
        columns, count = self.columns(), len(cloud.xyz)
        begun = seeds({name: columns[name] for name in ("means", "scales")}, cloud)
        voxel = float(begun["scales"].exp().median())
        return begun | {
            "opacities": torch.full((count,), FULL),
            "feature": torch.zeros(count, self.feature),
            "offsets": torch.zeros(count, self.offsets, 3),
            "level": torch.zeros(count),
            "extra": torch.zeros(count),
            TABLE: LevelTable(1.0, 1, 1, voxel, 2.0).stored(),
            **fresh_networks(columns, generator),
        }

    def activate(self, params: Columns, degree: int) -> Splats:
        """See `Primitive.activate`: anchors of the kind "anchor", which `render` decodes."""
        means, sizes = params["means"], params["scales"].exp()
        extra = {"sizes": sizes, "feature": params["feature"], "offsets": params["offsets"]}
        extra |= {name: params[name].detach() for name in ("level", "extra")}
        networks = network_columns(self.feature, self.hidden, self.offsets)
        return Splats(
            "anchor",
            means,
            means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4),
            sizes[:, :3],
            SIGMOID.value(params["opacities"]),
            means.new_zeros(len(means), 1, 3),
            extra=extra,
            shared={name: params[name] for name in networks} | {TABLE: params[TABLE].detach()},
        )

    def needed(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """(V,) int64, the anchors that a camera needs: of a level that it draws, and with a part in view."""
        with torch.no_grad():
            extra, sizes = splats.extra, splats.extra["sizes"]
            drawn = LevelTable.of(splats.shared[TABLE]).is_drawn(splats.means, extra["level"], extra["extra"], camera)
            shift = (extra["offsets"] * sizes[:, None, :3]).norm(dim=-1).amax(-1)
            reach = shift + CUTOFF * sizes[:, 3:].amax(-1)
            return (drawn & is_in_view(splats.means, reach, camera, near)).nonzero()[:, 0]

    def derived(self, splats: Splats, camera: Camera, near: float) -> tuple[Splats, Tensor]:
        """The Gaussians or surfels of a view, and the anchor of each; see `decode`."""
        return decode(self.draws, splats, self.needed(splats, camera, near), camera.centre)

    def render(
        self,
        splats: Splats,
        camera: Camera,
        rasterizer: Rasterizer,
        near: float,
        geometry: bool = True,
        distortion: bool = True,
    ) -> Render:
        """See `Primitive.render`."""
        return DerivedRender(
            splats,
            camera,
            lambda anchors: self.derived(anchors, camera, near),
            lambda made: rasterizer.render(made, camera, near, geometry, distortion),
        )

    def contribution(
        self,
        splats: Splats,
        camera: Camera,
        rasterizer: Rasterizer,
        near: float,
        alpha_power: float,
        transmittance_power: float,
    ) -> tuple[Tensor, Tensor]:
        """See `Primitive.contribution`; that of an anchor is the sum over its Gaussians."""
        with torch.no_grad():
            made, owner = self.derived(splats, camera, near)
        found = rasterizer.contribution(made, camera, near, alpha_power, transmittance_power)
        total, hits = (summed_by_owner(value, owner, len(splats)) for value in found)
        return total, hits

    def opacity_before(
        self, splats: Splats, camera: Camera, rasterizer: Rasterizer, near: float, points: Tensor
    ) -> Tensor:
        """See `Primitive.opacity_before`."""
        with torch.no_grad():
            made, _ = self.derived(splats, camera, near)
        return rasterizer.opacity_before(made, camera, near, points)
