"""Where copies are kept that are dear to make and can be made again."""

from __future__ import annotations

import os
from pathlib import Path

from surfkit.core.check import BadInput


def cache_root() -> Path:
    """The user's cache: $SURFKIT_CACHE, else surfkit in $XDG_CACHE_HOME, else ~/.cache/surfkit.

    Raises:
        BadInput: None of them is known.
    """
    if own := os.environ.get("SURFKIT_CACHE"):
        return Path(own).absolute()
    if there := os.environ.get("XDG_CACHE_HOME"):
        return Path(there).absolute() / "surfkit"
    try:
        return Path.home().absolute() / ".cache" / "surfkit"
    except RuntimeError as error:  # as in a container, where HOME is not set and the user has no name
        raise BadInput("HOME is not set, and the user has no home folder; set HOME, or SURFKIT_CACHE") from error
