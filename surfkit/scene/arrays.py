"""Arrays in .npy files, opened by any thread, and written."""

from __future__ import annotations

from pathlib import Path
from threading import Lock
from typing import BinaryIO

import numpy as np

_PARSING = Lock()
"""numpy reads headers with Python's own parser, which in Python 3.11 does not bear two threads at a time."""


def map_array(path: Path) -> np.ndarray:
    """The array, mapped from disk: memory is not taken because a header says so.

    Raises:
        Exception: Of any kind, where the header is damaged: it is parsed as Python.
    """
    with _PARSING, np.errstate(over="ignore"):
        return np.lib.format.open_memmap(path, "r")


def write_array(file: BinaryIO, values: np.ndarray) -> None:
    """Write an array as `np.save` does; where the disk is full, the OSError of `np.save` has no number that says so."""
    values = np.ascontiguousarray(values)
    np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
    file.write(values.data)
