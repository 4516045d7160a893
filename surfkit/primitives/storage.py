"""Where the columns of points lie: in the memory of a device, or in files that are mapped into memory."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

CHUNK_BYTES = 1 << 24
"""Written at once where a system cannot reserve the room of a file."""


@dataclass(frozen=True)
class Storage:
    """The memory of a device: of that where a column already is, or of the one that is named."""

    device: torch.device | None = None

    def empty(self, rows: int, like: Tensor) -> Tensor:
        """(rows, ...) without values, of the type and device of a column (N, ...)."""
        return like.new_empty(rows, *like.shape[1:])

    def zeros(self, rows: int, like: Tensor) -> Tensor:
        """The same, all 0."""
        return like.new_zeros(rows, *like.shape[1:])

    def held(self, value: Tensor) -> Tensor:
        """A column (N, ...) in this storage: itself if it is there already, else a copy."""
        return value if self.device is None else value.to(self.device)


@dataclass(frozen=True)
class DiskStorage(Storage):
    """Files in a folder, mapped into memory: the system reads what is used, and puts the rest aside where it needs the
    memory.

    A file has no name, so that nothing is left of it when the process ends, in whatever way. Its room on the disk is
    reserved first: a full disk is an error here, and not the end of the process when a value is written. (File systems
    that write changed blocks to new places, such as Btrfs and ZFS, cannot promise that.)
    """

    device: torch.device | None = torch.device("cpu")
    folder: Path = Path()

    def empty(self, rows: int, like: Tensor) -> Tensor:
        """See `Storage.empty`; new files read as 0.

        Raises:
            OSError: There is no room on the disk, or no file can be made in the folder.
        """
        shape = (rows, *like.shape[1:])
        size = math.prod(shape) * like.itemsize
        if size == 0:
            return torch.empty(shape, dtype=like.dtype)
        with tempfile.TemporaryFile(dir=self.folder) as file:
            try:
                _reserve(file.fileno(), size)
            except OSError as error:
                error.filename = str(self.folder)
                raise
            room = mmap.mmap(file.fileno(), size)
        return torch.frombuffer(room, dtype=like.dtype).view(shape)

    def zeros(self, rows: int, like: Tensor) -> Tensor:
        """See `Storage.zeros`."""
        return self.empty(rows, like)

    def held(self, value: Tensor) -> Tensor:
        """See `Storage.held`; always a copy."""
        return self.empty(len(value), value).copy_(value)


def _reserve(file: int, size: int) -> None:
    """Let a new file have so many bytes of the disk."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
        return
    for start in range(0, size, CHUNK_BYTES):  # macOS and Windows
        os.write(file, bytes(min(CHUNK_BYTES, size - start)))
