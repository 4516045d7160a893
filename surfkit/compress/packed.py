"""Points along a space-filling curve, all values as multiples of steps, harmonics along their principal components."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.base import Compressor, Plan, kinds_of
from surfkit.compress.colors import SH_COLUMNS, PrincipalComponents, principal_components, vectors
from surfkit.compress.encoding import ColumnType, Encoding
from surfkit.compress.lossless import exact
from surfkit.compress.scalars import LogSteps, MortonPositions, SmallestThree, UniformLevels
from surfkit.core.check import BadInput
from surfkit.primitives.columns import EXP
from surfkit.primitives.model import SplatModel

PCA_POINTS = 1 << 18
"""Points that principal components are found from."""


@dataclass(frozen=True)
class Packed(Compressor):
    """Points along a Morton curve by the steps from one to the next; all values as multiples of steps, spherical
    harmonics along their principal components. The smallest at the same quality."""

    position: float = 0.02
    """Cubes for positions, as a share of the median radius of the splats; the next smaller power of 2 is taken."""

    scale: float = 0.05
    """Steps of the logarithm of radii."""

    rotation: float = 0.005
    """Steps of the components of unit quaternions."""

    opacity: float = 0.008
    """Steps of opacities."""

    color: float = 0.02
    """Steps of the coefficients of the spherical harmonics, along their principal components."""

    def __post_init__(self) -> None:
        for each in fields(self):
            if not 0 < getattr(self, each.name) < math.inf:
                raise BadInput(f"compress.{each.name} is {getattr(self, each.name)}; it must be above 0")

    def coarser(self, factor: float) -> Packed:
        """See `Compressor.coarser`."""
        return replace(self, **{each.name: getattr(self, each.name) * factor for each in fields(self)})

    def plan(
        self, model: SplatModel, importance: Tensor | None, seed: int, device: torch.device = torch.device("cpu")
    ) -> Plan:
        """See `Compressor.plan`."""
        kinds, tables = kinds_of(model), {}
        found = shape_encodings(model, self.position, self.scale, self.rotation, self.opacity)
        if set(SH_COLUMNS) <= set(kinds):
            step = max(1, len(model) // PCA_POINTS)
            tables = principal_components(vectors({name: model.params[name][::step] for name in SH_COLUMNS}))
            found[SH_COLUMNS] = PrincipalComponents(self.color)
        return Plan(encodings_of(kinds, found), tables)


def shape_encodings(
    model: SplatModel, position: float | None, scale: float, rotation: float, opacity: float
) -> dict[tuple[str, ...], Encoding]:
    """Encodings of the columns of shape and opacity that a model has, by their names.

    Args:
        model: With columns as those of 3DGS, or others, which are left out.
        position: Share of the median radius; None gives positions 16 bits in their leaf.
        scale, rotation, opacity: See `Packed`.
    """
    kinds = kinds_of(model)
    found: dict[tuple[str, ...], Encoding] = {}
    found["means",] = MortonPositions("means", None if position is None else position_exponent(model, position, scale))
    if "scales" in kinds and _are_lengths(model, kinds["scales"]):
        found["scales",] = LogSteps("scales", scale)
    if kinds.get("quats", ColumnType(())).shape == (4,):
        found["quats",] = SmallestThree("quats", min(rotation, 0.25))
    if "opacities" in kinds and _within_0_and_1(model, kinds["opacities"]):
        found["opacities",] = UniformLevels("opacities", int(min(max(round(1 / opacity), 2), 65_536)))
    return found


def encodings_of(kinds: dict[str, ColumnType], found: dict[tuple[str, ...], Encoding]) -> tuple[Encoding, ...]:
    """One encoding for each column: those found, and exact floats for the others."""
    taken = {name for names in found for name in names}
    return (*found.values(), *(exact(name, str(kind.dtype)) for name, kind in kinds.items() if name not in taken))


def position_exponent(model: SplatModel, share: float, step: float) -> int:
    """The side of cubes, 2^it, that is `share` of the median radius or less; the same for radii rounded to `step`."""
    kind = kinds_of(model).get("scales")
    if kind is None or not _are_lengths(model, kind) or not len(model):
        return -1000  # as small as floats are
    radii = model.params["scales"].reshape(len(model), -1)
    logs = radii if kind.activation is EXP else kind.activation.value(radii).log()
    rounded = np.rint(logs.amin(1).double().numpy() / step) * step
    median = float(np.median(rounded))
    if not math.isfinite(median):
        raise BadInput("scales: NaN or Inf; such a model is of no use")
    return math.floor((median + math.log(share)) / math.log(2) + 1e-6)


def _are_lengths(model: SplatModel, kind: ColumnType) -> bool:
    if kind.activation is EXP or not len(model):
        return True
    return bool(kind.activation.value(model.params["scales"].min().double()) > 0)


def _within_0_and_1(model: SplatModel, kind: ColumnType) -> bool:
    if not len(model):
        return True
    values = kind.activation.value(torch.stack([model.params["opacities"].min(), model.params["opacities"].max()]))
    return bool((values >= 0).all() and (values <= 1).all())
