"""Which surfkit this is."""

from __future__ import annotations

import importlib.metadata


def own_version() -> str:
    """The installed version of surfkit, or "unknown" when it runs from a bare source tree."""
    try:
        return importlib.metadata.version("surfkit")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
