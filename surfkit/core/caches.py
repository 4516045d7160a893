"""Where copies are kept that are dear to make and can be made again."""

from __future__ import annotations

import os
from pathlib import Path


def cache_root() -> Path:
    """The user's cache: $SURFKIT_CACHE, else surfkit in $XDG_CACHE_HOME, else ~/.cache/surfkit."""
    if own := os.environ.get("SURFKIT_CACHE"):
        return Path(own).absolute()
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home).absolute() / "surfkit"
