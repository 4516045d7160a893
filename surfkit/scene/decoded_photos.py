"""Decoded and resized copies of photographs, made once and kept on disk."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.caches import cache_root
from surfkit.core.files import replacing
from surfkit.scene.arrays import map_array, write_array

RESIZED_FOLDER = "resized"
FINGERPRINT_BYTES = 1 << 16
"""Bytes at either end of a file that stand for all of it."""


@dataclass(frozen=True)
class DecodedPhotoCache:
    """Decoded photographs on disk, for those that do not fit into memory.

    Attributes:
        root: The data set.
    """

    root: Path

    def get(self, path: Path, key: str, shape: tuple[int, ...], make: Callable[[], np.ndarray]) -> np.ndarray:
        """The copy of a file, or what `make` gives, which is then the copy.

        Args:
            path: The file; when it changes, the copy is made again.
            key: How it is used.
            shape: Of the copy.
            make: Gives an array of uint8.
        """
        copy = place(self.root, RESIZED_FOLDER) / f"{path.stem}-{digest(self.root, key, [path])}.npy"
        try:
            pixels = map_array(copy)
            if pixels.shape == shape and pixels.dtype == np.uint8:
                return np.array(pixels)
        except Exception:  # it is not there, or damaged, of which numpy raises whatever comes
            pass
        pixels = make()
        with replacing(copy) as file:
            write_array(file, pixels)
        return pixels


def place(root: Path, name: str) -> Path:
    """A folder for copies in the data set; where that cannot be written, in the user's own cache."""
    if os.access(root, os.W_OK):
        return root / name
    return cache_root() / name


def digest(root: Path, key: str, paths: Sequence[Path]) -> str:
    """A name that depends on all that went into a copy: a key, and the first file's place and the content of all."""
    found = hashlib.blake2b(f"{key} {os.path.relpath(paths[0], root)}".encode(), digest_size=8)
    for path in paths:
        found.update(_content(path))
    return found.hexdigest()


def _content(path: Path) -> bytes:
    """Size and both ends of a file; whole photographs would take minutes to read in a large data set."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(FINGERPRINT_BYTES)
        file.seek(max(0, size - FINGERPRINT_BYTES))
        return size.to_bytes(8, "little") + head + file.read()
