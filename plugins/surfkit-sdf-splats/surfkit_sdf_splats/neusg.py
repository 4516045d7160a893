"""NeuSG (Chen et al. 2023): Gaussians pressed flat lie on the zero set of a signed distance and are turned as it is.

The words of the paper: "scale regularizer" pulls the centre of a Gaussian to the surface by making it "extremely
thin"; the point cloud of the Gaussians guides the distance, |f(x)| = 0, and the gradient of the distance refines the
Gaussians, whose normal is their thinnest axis. There is no published code; the weights are ours.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from surfkit_neus.method import NeuS
from surfkit_neus.train import batch_losses
from torch import Tensor
from torch.nn.functional import one_hot

from surfkit.plugin import (
    L1,
    SSIM,
    BadInput,
    CompletedStep,
    MethodInput,
    Regularizer,
    RegularizerInput,
    Splats,
    Stage,
    name_of,
    require_within,
    rotated,
)
from surfkit_sdf_splats.branches import Link, Surface, counted
from surfkit_sdf_splats.method import SplatsWithDistance


def thinnest(splats: Splats) -> Tensor:
    """(N, 3) unit normals of Gaussians, their thinnest axes; of discs, the third."""
    scales = splats.scales.detach()
    axis = scales.argmin(1) if scales.shape[1] == 3 else torch.full_like(scales[:, 0], 2, dtype=torch.int64)
    return rotated(one_hot(axis, 3).to(splats.means), splats.quats)


@dataclass(frozen=True)
class Thin(Regularizer):
    """Mean of the smallest scale of each Gaussian (NeuSG, scale regularizer), local units; 0 for discs, which are flat
    already."""

    weight: float = 1.0
    """Loss weight."""

    def __post_init__(self) -> None:
        require_within({"weight": (0, 1e6)}, self)

    def weight_at(self, index: int, steps: int) -> float:
        """See `Regularizer.weight_at`."""
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        """See `Regularizer.__call__`."""
        return splats.scales.amin(1).mean() if splats.scales.shape[1] == 3 else 0 * splats.scales.sum()


def apart(sdf: Tensor, gradient: Tensor, moved: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """(P,) |f| at the centres of Gaussians, and (P,) 1 - |n . grad f| of their normals, which have no sign.

    Args:
        sdf: (P,) distances at the centres.
        gradient: (P, 3) of these.
        moved: (P, 3) centres, less what they are now: zeros, by which the distance is differentiated. What a move
            changes of the gradient does not count: the paper takes the normals of the surface as they are.
        normal: (P, 3) unit normals of the Gaussians.
    """
    facing = (torch.nn.functional.normalize(gradient, dim=1) * normal).sum(1)
    return (sdf + (gradient * moved).sum(1)).abs(), 1 - facing.abs()


@dataclass
class Guidance(Link):
    """The agreement of Gaussians and surface at centres that are drawn anew in each step."""

    method: NeuSG
    surface: Surface
    shared: dict[str, Tensor] = field(default_factory=dict)

    def tied(self, stage: Stage) -> Stage:
        """See `Link.tied`."""
        more = {"thin": Thin(self.method.thin), "agree": Agreement(self)}
        return replace(stage, regularizers={**stage.regularizers, **more})

    def losses(self, done: CompletedStep) -> dict[str, Tensor]:
        """See `Link.losses`: those of NeuS, and how far the surface is from the Gaussians."""
        return batch_losses(self.surface.settings, self.surface.state, self.surface.batches) | self.shared

    def agreement(self, splats: Splats, seed: int) -> Tensor:
        """Scalar: how far Gaussians are from the surface. The other half, by the surface, is kept for `losses`."""
        method, surface = self.method, self.surface
        draw = torch.Generator().manual_seed(seed)
        rows = torch.randint(len(splats), (method.centres,), generator=draw).to(splats.means.device)
        some = splats.take(rows)
        x = surface.inward(some.means)
        weight = some.opacities.detach().to(x) * surface.box.holds(x)
        with torch.enable_grad():
            there = surface.geometry(x)
            normal = thinnest(some) @ surface.box.axes.T.to(some.means)
            far, tilt = apart(there.sdf, there.gradient, torch.zeros_like(x), normal.detach().to(x))
        self.shared = {
            "points": method.points * counted(weight, far),
            "normals": method.normals * counted(weight, tilt),
        }
        # In units of the box, so that one of them is as long for the Gaussians as it is for the surface.
        moved = (some.means - some.means.detach()) @ surface.box.axes.T.to(some.means) / surface.box.scale
        known = there.sdf.detach().to(moved), there.gradient.detach().to(moved)
        far, tilt = apart(*known, moved, normal)
        weight = weight.to(moved)
        return method.to_surface * counted(weight, far) + method.to_normal * counted(weight, tilt)


@dataclass(frozen=True)
class Agreement(Regularizer):
    """What the surface makes of the Gaussians, from its first step on."""

    link: Guidance

    def weight_at(self, index: int, steps: int) -> float:
        """See `Regularizer.weight_at`."""
        return float(index > self.link.surface.alone)

    def __call__(self, splats: Splats) -> Tensor:
        """See `Regularizer.__call__`."""
        return self.link.agreement(splats, 0)

    def in_step(self, splats: Splats, given: RegularizerInput) -> Tensor:
        """See `Regularizer.in_step`."""
        return self.link.agreement(splats, given.target.seed)


def _splats() -> Stage:
    return Stage(losses={"l1": L1(), "ssim": SSIM()})


@dataclass(frozen=True)
class NeuSG(SplatsWithDistance):
    """A neural signed distance and flat Gaussians on its zero set guide each other (NeuSG, Chen et al. 2023)."""

    splats: Stage = field(default_factory=_splats)
    """Optimisation of the splats. Its steps are those of the whole run."""

    surface: NeuS = NeuS()
    """The signed distance (NeuS). Its steps are the last ones of the run; before them, the splats are optimised alone:
    by default, none."""

    thin: float = 1.0
    """Weight of the mean smallest scale of the Gaussians, as a share of the scene extent."""

    centres: int = 1024
    """Gaussians, drawn at random, that are compared with the surface in a step."""

    points: float = 1.0
    """Weight of the distance at the centres of the Gaussians, which is to be 0, for the surface."""

    normals: float = 0.1
    """Weight of the angle between its gradient and the normals of the Gaussians, for the surface."""

    to_surface: float = 0.1
    """Weight of the same distance, for the Gaussians, which it moves."""

    to_normal: float = 0.01
    """Weight of the same angle, for the Gaussians, which it turns."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within({"centres": (1, 2**24)}, self)
        require_within(dict.fromkeys(("thin", "points", "normals", "to_surface", "to_normal"), (0, 1e6)), self)

    def refuse_unfit(self, given: MethodInput) -> None:
        """See `Method.refuse_unfit`."""
        if not (primitive := given.used["primitive"]).in_ply:
            raise BadInput(
                f"primitive:{name_of(primitive)}: its points are no Gaussians with axes of their own; choose gaussian3d"
            )
        super().refuse_unfit(given)

    def link(self, surface: Surface) -> Guidance:
        """See `SplatsWithDistance.link`."""
        return Guidance(self, surface)
