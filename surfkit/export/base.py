"""What a file format of splats is."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

from surfkit.core.check import BadInput
from surfkit.core.registry import Component, name_of
from surfkit.export.table import SplatTable, Tile
from surfkit.scene.scene import Frame


class Format(Component):
    """A file format of splats, by the name that `surfkit export --format` takes."""

    suffix: ClassVar[str] = ""
    """How file names end, such as ".spz"; "" for a folder."""
    wants_tree: ClassVar[bool] = False
    """Whether it holds levels of detail, so that `write` is given a tree."""

    @abstractmethod
    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """Write a file, which appears only when it is complete.

        Args:
            path: Of the file, or of the folder for a format without suffix.
            table: In the frame that the file shall have, positions in float64 or float32.
            frame: That of the input, if the table is in it. Its shift is left out of the coordinates of formats of
                float32 or less; those that have a place for it name the shift, the coordinate system and the unit.
            tree: The same splats as tiles with levels of detail, in the same frame; for formats that want one.

        Raises:
            BadInput: The format has no place for such splats.
        """

    def read(self, path: Path) -> SplatTable:
        """The splats of a file, as `write` was given them but for the rounding of the format.

        Raises:
            BadInput: Not such a file, damaged, or the format can be written only.
        """
        raise BadInput(f"{path}: files of the format {name_of(self)} are written, and not read")

    def knows(self, path: Path, head: bytes) -> bool:
        """Whether a file is of this format; `head` is what it begins with, up to 4,096 bytes."""
        return False
