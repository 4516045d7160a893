"""States on disk whose points are read and written piece by piece: they may be more than memory holds.

A file is opened anew for every piece. What is read of a mapped file counts as memory of the process for as long as it
is mapped, and a scene would be, though nothing keeps it.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor

from surfkit.primitives.points import Columns, Points
from surfkit.train import checkpoint
from surfkit.train.checkpoint import CHECKPOINT_FORMAT
from surfkit.train.state import StageState

PIECE_POINTS = 1 << 16
"""Points of a piece."""
CHUNK_BYTES = 1 << 24
"""Read at once where rows do not matter."""
POINT_TENSOR_PREFIXES = ("params.", "first.", "second.", "stats.", "frozen.")
"""What names of tensors that have a row for each point, or for each frozen one, begin with."""
SAFETENSORS_TYPES = {
    torch.float32: "F32",
    torch.float64: "F64",
    torch.bfloat16: "BF16",
    torch.int64: "I64",
    torch.uint8: "U8",
}
"""Types as safetensors names them."""


@dataclass(frozen=True)
class StoredState:
    """A whole state in a file.

    Attributes:
        path: The file.
        state: The state, but its points have no values (they are on the device "meta").
    """

    path: Path
    state: StageState

    def pieces(self) -> Iterator[StageState]:
        """The state with some of its points each time, in their order, and without moments and statistics."""
        for start in range(0, len(self.state.points), PIECE_POINTS):
            yield self.rows(start, start + PIECE_POINTS)

    def rows(self, start: int, end: int) -> StageState:
        """The state with the points from one row to before another, and without moments and statistics."""
        names = self.state.points.params
        with checkpoint.reading(self.path) as (file, _):
            params = {name: file.get_slice(f"params.{name}")[start:end].clone() for name in names}
        return replace(self.state, points=Points(params, {}, {}, shared=self.state.points.shared))

    def column(self, name: str) -> Tensor:
        """(N, ...) a column of statistics of all points."""
        with checkpoint.reading(self.path) as (file, _):
            return file.get_tensor(f"stats.{name}").clone()


def open_last(path: Path) -> tuple[StoredState, str | None] | None:
    """As `checkpoint.load_last`, but the points stay in the file."""
    return checkpoint.last_whole(path, opened)


def opened(path: Path) -> StoredState:
    """The state in a file, which is read to its end once, as what is damaged must not be used.

    Raises:
        BadInput: It cannot be used.
    """
    with checkpoint.reading(path) as (file, metadata):
        tensors = {name: _without_values(file, name) for name in file.keys()}
    if _digest(path, tensors, metadata["facts"]) != metadata.get("digest"):
        raise checkpoint.damaged(path)
    with checkpoint.reading(path) as (file, _):
        small = {name: file.get_tensor(name).clone() for name in tensors if not name.startswith(POINT_TENSOR_PREFIXES)}
    return StoredState(path, checkpoint.state_of(path, tensors | small, metadata["facts"]))


def save(path: Path, state: StageState, pieces: Iterable[Columns]) -> None:
    """Write a state as `checkpoint.save` does, with moments of 0.

    Args:
        path: To write to.
        state: Its parameters need have no values, only types and shapes; it has no statistics.
        pieces: The parameters of all points, in their order.

    Raises:
        OSError: It cannot be written; what was there stays.
    """
    small, facts = checkpoint.beside_points(state)
    params = state.points.params
    groups = {f"params.{name}": value for name, value in params.items()}
    moments = {f"{g}.{name}": value for g in ("first", "second") for name, value in state.points.all_params().items()}
    tensors = small | groups | moments
    with checkpoint.taking_the_place(path) as part:
        with open(part, "wb") as file:
            starts = begin(file, tensors, facts, "0" * 64)
            for name, value in small.items():
                file.seek(starts[name])
                file.write(bytes_of(value))
            done = 0
            for piece in pieces:
                for name, value in piece.items():
                    file.seek(starts[f"params.{name}"] + done * math.prod(value.shape[1:]) * value.itemsize)
                    file.write(bytes_of(value))
                done += len(piece["means"])
            assert done == len(state.points), "the pieces are not the points"
        finish(part, tensors, facts)


def finish(part: Path, tensors: dict[str, Tensor], facts: str) -> None:
    """Give a file whose values, (N, ...) each, are all written its digest, and let the disk know it."""
    digest = _digest(part, tensors, facts)
    with open(part, "rb+") as file:
        begin(file, tensors, facts, digest)
        file.flush()
        os.fsync(file.fileno())


def begin(file: BinaryIO, tensors: dict[str, Tensor], facts: str, digest: str) -> dict[str, int]:
    """Write what comes before the values, (N, ...) each, as in safetensors; where those of each tensor go."""
    header: dict[str, Any] = {"__metadata__": {"format": CHECKPOINT_FORMAT, "facts": facts, "digest": digest}}
    ends = 0
    for name, value in sorted(tensors.items(), key=lambda item: (-item[1].itemsize, item[0])):  # so that all is aligned
        begins, ends = ends, ends + value.numel() * value.itemsize
        header[name] = {
            "dtype": SAFETENSORS_TYPES[value.dtype],
            "shape": list(value.shape),
            "data_offsets": [begins, ends],
        }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    file.write(len(text).to_bytes(8, "little") + text)
    file.truncate(8 + len(text) + ends)
    return {name: 8 + len(text) + header[name]["data_offsets"][0] for name in tensors}


def bytes_of(value: Tensor) -> memoryview:
    """What a file has of a tensor (N, ...)."""
    return value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data


def _without_values(file: Any, name: str) -> Tensor:
    part = file.get_slice(name)
    like = part[0:0] if part.get_shape() else file.get_tensor(name)
    return torch.empty(part.get_shape(), dtype=like.dtype, device="meta")


def _digest(path: Path, tensors: dict[str, Tensor], facts: str) -> str:
    """The digest of the values in a file, which are as many as `tensors` have."""

    def values(name: str, like: Tensor) -> Iterator[Tensor]:
        rows = max(1, CHUNK_BYTES // max(1, math.prod(like.shape[1:]) * like.itemsize))
        for start in range(0, len(like) if like.dim() else 1, rows):
            with checkpoint.reading(path) as (file, _):
                yield file.get_slice(name)[start : start + rows] if like.dim() else file.get_tensor(name)

    return checkpoint.digest(facts, ((name, tensors[name], values(name, tensors[name])) for name in sorted(tensors)))
