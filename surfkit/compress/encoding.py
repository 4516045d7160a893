"""How the columns of a model become whole numbers, leaf by leaf, and how far what comes back may differ."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.octree import Leaf
from surfkit.compress.streams import Streams, array
from surfkit.core.check import BadInput
from surfkit.core.registry import Component
from surfkit.primitives.columns import IDENTITY, Activation
from surfkit.primitives.points import Columns

Tables = Mapping[str, np.ndarray]
"""Arrays that all leaves share, such as codebooks."""
MAX_QUANTIZED = 1 << 22


@dataclass(frozen=True)
class ColumnType:
    """What is known of a column without its values.

    Attributes:
        shape: Of a point's values.
        dtype: Of its numbers, float32 or float64.
        activation: What they stand for.
    """

    shape: tuple[int, ...]
    dtype: torch.dtype = torch.float32
    activation: Activation = field(default=IDENTITY, compare=False)

    @property
    def width(self) -> int:
        """Numbers of a point."""
        return math.prod(self.shape)

    def rows(self, numbers: np.ndarray) -> Tensor:
        """(n, width) numbers as values of this column."""
        return torch.from_numpy(np.array(numbers, order="C")).to(self.dtype).view(len(numbers), *self.shape)


@dataclass(frozen=True)
class Encoding(Component):
    """How some columns become streams of whole numbers; its settings stand in the file, and say how to read them."""

    @property
    @abstractmethod
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that it takes."""

    @abstractmethod
    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """Streams of the n points of a leaf, each (rows, components) of an unsigned type.

        Args:
            values: Columns of these points, in the order of the leaf.
            kinds: What is known of every column of the model.
            leaf: Where the points lie.
            tables: Of the whole file.

        Raises:
            BadInput: Values that it has no place for.
        """

    @abstractmethod
    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """The columns of the `count` points of a leaf, but for what was rounded.

        Raises:
            BadInput: Streams or tables that do not fit.
        """


def flat(values: Columns, name: str) -> np.ndarray:
    """(n, width) numbers of a column."""
    numbers = values[name].detach().cpu()
    return numbers.reshape(len(numbers), math.prod(numbers.shape[1:])).numpy()


def stream(streams: Streams, name: str, rows: int, components: int) -> np.ndarray:
    """A stream (rows, components), or BadInput where it has another shape."""
    found = streams.get(name)
    if found is None or found.shape != (rows, components):
        what = "is missing" if found is None else f"is {found.shape[0]} x {found.shape[1]}"
        raise BadInput(f"stream {name} {what}; {rows} x {components} are needed")
    return array(found)


def from_whole(name: str, numbers: np.ndarray) -> dict[str, np.ndarray]:
    """Streams of (n, components) whole numbers of any sign, as differences from their medians.

    Raises:
        BadInput: Numbers of 2^22 or more, whose multiples of a step float32 does not tell apart.
    """
    if numbers.size and not np.abs(numbers).max() < MAX_QUANTIZED:
        raise BadInput(f"{name}: values of more than 2^22 steps; take longer steps, or compress:float16")
    middle = np.median(numbers, 0, keepdims=True).round() if numbers.size else np.zeros((1, numbers.shape[1]))
    return {f"{name}.middle": _smallest(_zigzag(middle)), name: _smallest(_zigzag(numbers - middle))}


def multiples(
    streams: Streams, name: str, rows: int, components: int, step: float, dtype: torch.dtype | None = None
) -> np.ndarray:
    """(rows, components) multiples of a step that `from_whole` made streams of, rounded to a float type.

    By default float32 if all numbers have 16 bits, which is enough for sums of products of them, and float64 if not.
    """
    middle, numbers = stream(streams, f"{name}.middle", 1, components), stream(streams, name, rows, components)
    short = middle.dtype.itemsize <= 2 and numbers.dtype.itemsize <= 2
    single = short if dtype is None else dtype == torch.float32
    found = np.empty((components, rows), np.float32 if single else np.float64)
    for at, first in enumerate(_signed(middle)[0]):
        codes = numbers[:, at]
        if codes.dtype.itemsize > 2:
            found[at] = (first + _signed(codes)) * step
        elif rows:
            values = ((first + _signed(np.arange(int(codes.max()) + 1))) * step).astype(found.dtype)
            np.take(values, codes, out=found[at], mode="clip")
    return found.T


def _zigzag(numbers: np.ndarray) -> np.ndarray:
    """0, -1, 1, -2, ... as 0, 1, 2, 3, ..., in 32 bits."""
    numbers = numbers.astype(np.int32)
    return ((numbers << 1) ^ (numbers >> 31)).view(np.uint32)


def _signed(numbers: np.ndarray) -> np.ndarray:
    """The int64 numbers of `_zigzag`."""
    numbers = numbers.astype(np.int64)
    return (numbers >> 1) ^ -(numbers & 1)


def _smallest(numbers: np.ndarray) -> np.ndarray:
    """The same in the fewest bytes."""
    most = int(numbers.max(initial=0))
    return numbers.astype(np.uint8 if most < 1 << 8 else np.uint16 if most < 1 << 16 else np.uint32)
