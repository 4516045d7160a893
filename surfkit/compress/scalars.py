"""Encodings of single columns: floats, positions, lengths, opacities, rotations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from surfkit.compress.encoding import ColumnType, Encoding, Tables, flat, from_whole, multiples, stream
from surfkit.compress.octree import LEAF_POSITION_BITS, Leaf
from surfkit.compress.streams import Streams
from surfkit.core.check import BadInput
from surfkit.primitives.columns import EXP
from surfkit.primitives.points import Columns

FLOAT_TYPES = {"float16": np.float16, "float32": np.float32, "float64": np.float64}


@dataclass(frozen=True)
class OneColumn:
    """What encodings of a single column have in common."""

    column: str = "means"
    """Name of the column."""

    @property
    def columns(self) -> tuple[str, ...]:
        """See `Encoding.columns`."""
        return (self.column,)


@dataclass(frozen=True)
class Floats(OneColumn, Encoding):
    """Floats as they are, or rounded to fewer bytes."""

    kind: str = "float32"
    """float16, float32 or float64."""

    def __post_init__(self) -> None:
        if self.kind not in FLOAT_TYPES:
            raise BadInput(f"encoding floats: kind is {self.kind!r}; it must be {', '.join(FLOAT_TYPES)}")

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        return {self.column: float_bits(flat(values, self.column), self.kind, self.column)}

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        kind = kinds[self.column]
        return {self.column: kind.rows(bits_float(stream(streams, self.column, count, kind.width), self.kind))}


@dataclass(frozen=True)
class MortonPositions(OneColumn, Encoding):
    """Positions as cubes along a Morton curve, by the number of cubes from one to the next.

    A position comes back as the centre of its cube: off by `bound` on each axis, and by the rounding of its float.
    """

    exponent: int | None = None
    """The cubes have sides of 2^exponent local units, longer where a leaf is so large that 21 bits do not number them;
    None gives each leaf 16 bits on each axis."""

    def side(self, leaf: Leaf) -> int:
        """The side of the cubes in a leaf is 2^side."""
        return leaf.cell_exponent(leaf.exponent - LEAF_POSITION_BITS if self.exponent is None else self.exponent)

    def bound(self, leaf: Leaf) -> float:
        """How far from its place a position may come back, on each axis, local units."""
        return math.ldexp(0.5, self.side(leaf))

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        codes = leaf.codes(flat(values, self.column), self.side(leaf))
        return {self.column: np.diff(codes, prepend=np.uint64(0))[:, None]}

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        codes = np.cumsum(stream(streams, self.column, count, 1)[:, 0], dtype=np.uint64)
        if count and int(codes.max()) >> 3 * (leaf.exponent - self.side(leaf)):
            raise BadInput(f"stream {self.column} leads out of its leaf")
        return {self.column: kinds[self.column].rows(leaf.centres(codes, self.side(leaf)))}


@dataclass(frozen=True)
class LogSteps(OneColumn, Encoding):
    """Lengths as multiples of a step of their logarithm: they come back off by a factor of exp(step / 2) at most."""

    column: str = "scales"
    """Name of the column."""

    step: float = 0.1
    """Difference of the natural logarithms of lengths that can be told apart."""

    def __post_init__(self) -> None:
        if not 0 < self.step < math.inf:
            raise BadInput(f"encoding log-steps: step is {self.step}; it must be above 0")

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        numbers, activation = flat(values, self.column).astype(np.float64), kinds[self.column].activation
        if activation is not EXP:
            numbers = activation.value(torch.from_numpy(numbers)).log().numpy()
            if not np.isfinite(numbers).all():
                raise BadInput(f"{self.column}: lengths of 0 or less have no logarithm; choose compress:float16")
        return from_whole(self.column, np.rint(numbers / self.step))

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        kind = kinds[self.column]
        exact = kind.dtype if kind.activation is EXP else torch.float64
        numbers = multiples(streams, self.column, count, kind.width, self.step, exact)
        if kind.activation is not EXP:
            numbers = kind.activation.inverse(torch.from_numpy(numbers).exp()).numpy()
        return {self.column: kind.rows(numbers)}


@dataclass(frozen=True)
class UniformLevels(OneColumn, Encoding):
    """Activated values from 0 to 1 as evenly spaced levels: they come back off by 1 / (2 levels) at most."""

    column: str = "opacities"
    """Name of the column."""

    levels: int = 256
    """How many values can be told apart."""

    def __post_init__(self) -> None:
        if not 2 <= self.levels <= 65_536:
            raise BadInput(f"encoding levels: levels is {self.levels}; it must be 2 to 65536")

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        raw = torch.from_numpy(flat(values, self.column).astype(np.float64))
        shares = kinds[self.column].activation.value(raw).numpy()
        if ((shares < 0) | (shares > 1)).any():
            raise BadInput(f"{self.column}: values beyond 0 to 1 have no levels; choose compress:float16")
        levels = np.minimum(np.floor(shares * self.levels), self.levels - 1)
        return {self.column: levels.astype(np.uint8 if self.levels <= 256 else np.uint16)}

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        kind = kinds[self.column]
        levels = stream(streams, self.column, count, kind.width)
        shares = (np.minimum(levels, self.levels - 1) + 0.5) / self.levels
        return {self.column: kind.rows(kind.activation.inverse(torch.from_numpy(shares)).numpy())}


@dataclass(frozen=True)
class SmallestThree(OneColumn, Encoding):
    """Unit quaternions by their three smallest components and the place of the largest, which comes back positive.

    Each of the three comes back off by `step` at most: by half of it, and by more only where the largest component
    would not be the largest any more.
    """

    column: str = "quats"
    """Name of the column."""

    step: float = 0.01
    """Difference of components that can be told apart."""

    def __post_init__(self) -> None:
        if not 1e-6 <= self.step <= 0.25:
            raise BadInput(f"encoding smallest-three: step is {self.step}; it must be 1e-6 to 0.25")

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        quats = flat(values, self.column).astype(np.float64)
        rows, length = np.arange(len(quats)), np.linalg.norm(quats, axis=1, keepdims=True)
        quats = np.where(length > 0, quats / np.where(length > 0, length, 1), [[1.0, 0, 0, 0]])
        largest = np.abs(quats).argmax(1)
        quats *= np.where(quats[rows, largest] < 0, -1, 1)[:, None]
        exact = quats[rows[:, None], (largest[:, None] + [1, 2, 3]) % 4] / self.step
        numbers = np.rint(exact)
        for turn in range(4):  # nothing may come back as large as the largest
            rest = np.abs(numbers) * self.step
            worst = rest.argmax(1)
            wrong = rows[rest[rows, worst] ** 2 >= (1 - (rest**2).sum(1)) * (1 - 1e-6)]
            if turn:
                numbers[wrong, worst[wrong]] -= np.sign(numbers[wrong, worst[wrong]])
            else:
                numbers[wrong] = np.trunc(exact[wrong])
        return {f"{self.column}.largest": largest[:, None].astype(np.uint8)} | from_whole(self.column, numbers)

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        largest = (stream(streams, f"{self.column}.largest", count, 1)[:, 0] % 4).astype(np.int64)
        rest = multiples(streams, self.column, count, 3, self.step, torch.float64)
        quats, rows = np.zeros((count, 4)), np.arange(count)
        quats[rows, largest] = np.sqrt(np.maximum(1 - (rest**2).sum(1), 0))
        quats[rows[:, None], (largest[:, None] + [1, 2, 3]) % 4] = rest
        return {self.column: kinds[self.column].rows(quats)}


def float_bits(numbers: np.ndarray, kind: str, name: str) -> np.ndarray:
    """(n, width) floats as unsigned numbers of the same bits."""
    with np.errstate(over="ignore"):
        rounded = numbers.astype(FLOAT_TYPES[kind])
    if not np.isfinite(rounded).all():
        raise BadInput(f"{name}: values beyond what {kind} holds; choose compress:lossless")
    return np.frombuffer(rounded.tobytes(), f"<u{rounded.dtype.itemsize}").reshape(rounded.shape)


def bits_float(bits: np.ndarray, kind: str) -> np.ndarray:
    """(N, K) the floats of `float_bits`."""
    floats = FLOAT_TYPES[kind]
    if bits.dtype.itemsize != np.dtype(floats).itemsize:
        raise BadInput(f"a stream of {kind} has numbers of {bits.dtype.itemsize} bytes")
    return np.frombuffer(bits.tobytes(), floats).reshape(bits.shape)
