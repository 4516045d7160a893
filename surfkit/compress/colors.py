"""Encodings of the spherical harmonics of a point as one vector: codes of a codebook, or principal components."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from surfkit.compress.encoding import ColumnType, Encoding, Tables, flat, from_whole, multiples, stream
from surfkit.compress.octree import Leaf
from surfkit.compress.scalars import bits_float, float_bits
from surfkit.compress.streams import Streams
from surfkit.core.check import BadInput
from surfkit.primitives.points import Columns

SH_COLUMNS = ("sh0", "sh_rest")
CHOSEN_MARK = "sh.chosen"
"""The mark of points whose harmonics become codes."""


def vectors(values: Columns) -> np.ndarray:
    """(n, 3 K) coefficients of n points, the three colours of each in turn."""
    return np.concatenate([flat(values, name) for name in SH_COLUMNS], axis=1)


def colors(numbers: np.ndarray, kinds: Mapping[str, ColumnType]) -> Columns:
    """The columns of (n, 3 K) coefficients."""
    split = kinds[SH_COLUMNS[0]].width
    return {
        SH_COLUMNS[0]: kinds[SH_COLUMNS[0]].rows(numbers[:, :split]),
        SH_COLUMNS[1]: kinds[SH_COLUMNS[1]].rows(numbers[:, split:]),
    }


def width(kinds: Mapping[str, ColumnType]) -> int:
    """Coefficients of a point."""
    return sum(kinds[name].width for name in SH_COLUMNS)


@dataclass(frozen=True)
class PrincipalComponents(Encoding):
    """Spherical harmonics as multiples of a step along their principal components; the basis is a table of the file.

    The basis is orthonormal: the D coefficients of a point come back off by sqrt(D) step / 2 at most, as a vector.
    """

    step: float = 0.04
    """Difference of components that can be told apart."""

    def __post_init__(self) -> None:
        if not 0 < self.step < math.inf:
            raise BadInput(f"encoding principal-components: step is {self.step}; it must be above 0")

    @property
    def columns(self) -> tuple[str, ...]:
        """See `Encoding.columns`."""
        return SH_COLUMNS

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        basis, mean = _basis(tables, width(kinds))
        return from_whole("sh", np.rint((vectors(values) - mean) @ basis / self.step))

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        basis, mean = _basis(tables, width(kinds))
        found = multiples(streams, "sh", count, len(basis), self.step)
        numbers = found @ basis.T.astype(found.dtype)
        numbers += mean.astype(found.dtype)
        return colors(numbers, kinds)


def principal_components(numbers: np.ndarray) -> dict[str, np.ndarray]:
    """Tables for `PrincipalComponents`: orthonormal directions along which (n, D) vectors vary, the strongest first."""
    mean, square = np.zeros(numbers.shape[1]), np.zeros((numbers.shape[1],) * 2)
    for start in range(0, len(numbers), 1 << 16):
        part = numbers[start : start + (1 << 16)].astype(np.float64)
        mean += part.sum(0)
        square += part.T @ part
    mean = (mean / max(1, len(numbers))).astype(np.float32)
    if not np.isfinite(square).all():
        raise BadInput("spherical harmonics: NaN or Inf, or numbers whose squares are; such a model is of no use")
    covariance = square / max(1, len(numbers)) - np.outer(mean.astype(np.float64), mean)
    basis = np.linalg.eigh(covariance)[1][:, ::-1]
    return {"sh.basis": np.ascontiguousarray(basis.astype(np.float32)), "sh.mean": mean[None]}


def _basis(tables: Tables, size: int) -> tuple[np.ndarray, np.ndarray]:
    basis, mean = tables.get("sh.basis"), tables.get("sh.mean")
    if basis is None or mean is None or basis.shape != (size, size) or mean.shape != (1, size):
        raise BadInput(f"tables sh.basis and sh.mean are missing, or not of {size} coefficients")
    return basis.astype(np.float64), mean.astype(np.float64)


@dataclass(frozen=True)
class Codes(Encoding):
    """Spherical harmonics of the points that matter least as codes of a codebook (Vectree, LightGaussian), those of the
    others in float16.

    The mark `sh.chosen` says which points get codes, and the marks `sh.code.I` say which; without these, it is the
    nearest. Tables `sh.codes.I` hold (codes, D_I) vectors in float16.
    """

    parts: tuple[int, ...] = ()
    """Coefficients that each codebook is for, in their order; of all codebooks together as many as a point has."""

    @property
    def columns(self) -> tuple[str, ...]:
        """See `Encoding.columns`."""
        return SH_COLUMNS

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        from surfkit.compress.kmeans import nearest

        numbers, chosen = vectors(values), values[CHOSEN_MARK].numpy()
        found = {CHOSEN_MARK: np.packbits(chosen)[:, None], "sh": float_bits(numbers[~chosen], "float16", "sh")}
        for at, (part, book) in enumerate(zip(self._parts(), self._books(kinds, tables), strict=True)):
            name = f"sh.code.{at}"
            if name in values:
                codes = values[name].numpy()[chosen]
            else:
                wanted = torch.from_numpy(np.ascontiguousarray(numbers[chosen][:, part], np.float32))
                codes = nearest(wanted, torch.from_numpy(book))[0].numpy()
            found[name] = codes[:, None].astype(np.uint8 if len(book) <= 256 else np.uint16)
        return found

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        bits = stream(streams, CHOSEN_MARK, -(-count // 8), 1)[:, 0]
        chosen = np.unpackbits(bits.astype(np.uint8), count=count).astype(bool)
        numbers, codes = np.empty((count, width(kinds)), np.float32), int(chosen.sum())
        numbers[~chosen] = bits_float(stream(streams, "sh", count - codes, width(kinds)), "float16")
        for at, (part, book) in enumerate(zip(self._parts(), self._books(kinds, tables), strict=True)):
            code = stream(streams, f"sh.code.{at}", codes, 1)[:, 0]
            if codes and code.max() >= len(book):
                raise BadInput(f"stream sh.code.{at} names code {code.max()} of {len(book)}")
            numbers[np.nonzero(chosen)[0][:, None], np.arange(part.start, part.stop)] = book[code]
        return colors(numbers, kinds) | {CHOSEN_MARK: torch.from_numpy(chosen)}

    def _parts(self) -> list[slice]:
        ends = np.cumsum([0, *self.parts]).tolist()
        return [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]

    def _books(self, kinds: Mapping[str, ColumnType], tables: Tables) -> list[np.ndarray]:
        names = [f"sh.codes.{at}" for at in range(len(self.parts))]
        books = [tables[name] for name in names if name in tables]
        if [book.shape[1:] for book in books] != [(size,) for size in self.parts] or sum(self.parts) != width(kinds):
            raise BadInput(f"codebooks are missing, or not of {width(kinds)} coefficients together")
        return [book.astype(np.float32) for book in books]
