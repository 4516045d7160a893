"""Where depth maps lie."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from surfkit.plugin import BadInput, DepthFile, DepthLayout, DepthQuery


@dataclass(frozen=True)
class NewPart(DepthLayout):
    """Depths in the units of the data set, in a .npy file for each photograph, in a folder beside the photographs."""

    folder: str = "new-part"
    """The folder, relative to the data set."""

    def __post_init__(self) -> None:
        if not self.folder or Path(self.folder).is_absolute():
            raise BadInput(f"new-part.folder is {self.folder!r}; give a folder relative to the data set")

    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """See `DepthLayout.find`."""
        folder = query.root / self.folder
        if not folder.is_dir():
            return None
        paths = {name: (folder / name).with_suffix(".npy") for name in query.names}
        return {name: DepthFile(path, aligned=True, metric=True) for name, path in paths.items()}
