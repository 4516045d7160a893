"""The data set that the words of a command describe."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

from surfkit.scene.data import Data


def data_of(path: Path, command: Any) -> Data:
    """The data set at `path`, with the settings of `Data` that a command has too."""
    return Data(path, **{f.name: getattr(command, f.name) for f in fields(Data)[1:] if hasattr(command, f.name)})
