"""Arrays in .npy files, opened by any thread."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

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
