"""Vectree quantisation (CityGaussianV2, section 3.3, after LightGaussian): colours that matter little as codes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.base import Compressor, Plan, kinds_of
from surfkit.compress.colors import CHOSEN_MARK, SH_COLUMNS, Codes, vectors, width
from surfkit.compress.encoding import Tables
from surfkit.compress.kmeans import kmeans, nearest
from surfkit.compress.packed import encodings_of, shape_encodings
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.primitives.model import SplatModel

KMEANS_PASSES = 10
"""Of k-means."""
BATCH_POINTS = 1 << 18
"""Points whose codes are searched for at once."""
CODEBOOK_POINTS = 1 << 20
"""Points that a codebook is learnt from, so that memory does not grow with the model."""


@dataclass(frozen=True)
class Vectree(Compressor):
    """The spherical harmonics of the points that contribute least become codes of a codebook, those of the others
    float16; positions get 16 bits in the leaves of an octree; radii, rotations and opacities are rounded to steps."""

    needs_importance: ClassVar[bool] = True

    ratio: float = 0.4
    """Share of the points whose harmonics become codes: those with the lowest mean contribution to the training
    views."""

    codes: int = 8_192
    """Vectors of a codebook."""

    codebooks: Literal["one", "by-degree"] = "one"
    """One codebook for all harmonics of a point, or one for each of their degrees."""

    scale: float = 0.02
    """Steps of the logarithm of radii."""

    rotation: float = 0.002
    """Steps of the components of unit quaternions."""

    opacity: float = 1 / 256
    """Steps of opacities."""

    def __post_init__(self) -> None:
        if not 0 <= self.ratio <= 1:
            raise BadInput(f"compress.ratio is {self.ratio}; it must lie in 0 to 1")
        if not 1 <= self.codes <= 65_536:
            raise BadInput(f"compress.codes is {self.codes}; it must be 1 to 65536")
        for name in ("scale", "rotation", "opacity"):
            if not 0 < getattr(self, name) < float("inf"):
                raise BadInput(f"compress.{name} is {getattr(self, name)}; it must be above 0")

    def coarser(self, factor: float) -> Vectree:
        """See `Compressor.coarser`: more points get codes, of fewer vectors."""
        codes = int(min(max(round(self.codes / factor), 1), 65_536))
        steps = {name: getattr(self, name) * factor for name in ("scale", "rotation", "opacity")}
        return replace(self, ratio=min(1.0, self.ratio * factor), codes=codes, **steps)

    def plan(
        self, model: SplatModel, importance: Tensor | None, seed: int, device: torch.device = torch.device("cpu")
    ) -> Plan:
        """See `Compressor.plan`."""
        kinds = kinds_of(model)
        if not set(SH_COLUMNS) <= set(kinds):
            raise BadInput(f"compress:vectree needs the columns {' and '.join(SH_COLUMNS)}; choose compress:packed")
        if importance is None:
            raise BadInput("compress:vectree needs the contributions to training views; choose compress:packed")
        chosen = least(importance, self.ratio)
        rows = chosen.nonzero()[:, 0]
        if len(rows) > CODEBOOK_POINTS:
            draw = torch.Generator().manual_seed(seed)
            rows = rows[torch.randperm(len(rows), generator=draw)[:CODEBOOK_POINTS].sort().values]
        numbers = vectors({name: model.params[name][rows] for name in SH_COLUMNS})
        weights = importance[rows].float()
        parts = self.parts(width(kinds))
        ends = np.cumsum([0, *parts]).tolist()
        tables = {
            f"sh.codes.{at}": codebook(numbers[:, start:stop], self.codes, weights, seed, f"codebook {at + 1}", device)
            for at, (start, stop) in enumerate(zip(ends, ends[1:], strict=False))
        }
        found = shape_encodings(model, None, self.scale, self.rotation, self.opacity) | {SH_COLUMNS: Codes(parts)}
        return Plan(
            encodings_of(kinds, found), tables, {CHOSEN_MARK: chosen} | find_codes(model, chosen, parts, tables, device)
        )

    def parts(self, coefficients: int) -> tuple[int, ...]:
        """Coefficients that each codebook is for."""
        if self.codebooks == "one":
            return (coefficients,)
        return tuple(3 * (2 * degree + 1) for degree in range(int((coefficients // 3) ** 0.5)))


def least(importance: Tensor, ratio: float) -> Tensor:
    """(N,) bool, the `ratio` of the points with the lowest importance; of equal ones the first."""
    chosen = torch.zeros(len(importance), dtype=torch.bool)
    chosen[importance.argsort(stable=True)[: round(ratio * len(importance))]] = True
    return chosen


def find_codes(
    model: SplatModel, chosen: Tensor, parts: Sequence[int], tables: Tables, device: torch.device
) -> dict[str, Tensor]:
    """The marks of the codes of the chosen points: (N,) int32 for each codebook, 0 for others."""
    books = [torch.from_numpy(tables[f"sh.codes.{at}"].astype(np.float32)) for at in range(len(parts))]
    found = {f"sh.code.{at}": torch.zeros(len(model), dtype=torch.int32) for at in range(len(parts))}
    ends, rows = np.cumsum([0, *parts]).tolist(), chosen.nonzero()[:, 0]
    done = 0
    for some in rows.split(BATCH_POINTS):
        numbers = vectors({name: model.params[name][some] for name in SH_COLUMNS})
        for marks, book, start, stop in zip(found.values(), books, ends, ends[1:], strict=False):
            wanted = torch.from_numpy(np.ascontiguousarray(numbers[:, start:stop], np.float32))
            marks[some] = nearest(wanted, book, device)[0]
        emit(Progress("finding codes", done := done + len(some), len(rows)))
    return found


def codebook(
    numbers: np.ndarray, codes: int, weights: Tensor, seed: int, name: str, device: torch.device = torch.device("cpu")
) -> np.ndarray:
    """(C, D) float16 vectors for (n, D) ones, C at most `codes`; in an order that depends on nothing but themselves."""
    given = torch.from_numpy(np.ascontiguousarray(numbers, np.float32))
    if not given.isfinite().all():
        raise BadInput("spherical harmonics: NaN or Inf; such a model is of no use")
    if not len(given):
        return np.zeros((0, numbers.shape[1]), np.float16)
    weights = weights / weights.mean() if weights.sum() > 0 else torch.ones_like(weights)
    # A point that no view sees must not pull at a code, but may still be seen from elsewhere.
    found = kmeans(
        given,
        codes,
        weights.clamp_min(1e-3),
        seed=seed,
        iterations=KMEANS_PASSES,
        progress=lambda done, of: emit(Progress(name, done, of)),
        device=device,
    )
    rounded = found.numpy().astype(np.float16)
    if not np.isfinite(rounded).all():
        raise BadInput("spherical harmonics beyond what float16 holds; choose compress:lossless")
    return np.unique(rounded, axis=0)
