"""What a file format of splats is."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

from surfkit.core.check import BadInput
from surfkit.core.registry import Component, name_of
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.scene.scene import Frame

SNIFFED_BYTES = 4096
"""Bytes at the beginning of a file by which formats know it."""


class Format(Component):
    """A file format of splats; `surfkit export` takes `format:NAME`.

    Programs that know ellipsoids only are given surfels as thin ellipsoids (`SplatTable.ellipsoid_log_scales`); `read`
    makes surfels of them again (`as_surfels`, `as_surfels_if_thin`).
    """

    suffix: ClassVar[str] = ""
    """How file names end, such as ".spz"; "" for a folder."""
    wants_tree: ClassVar[bool] = False
    """Whether it holds levels of detail, so that `write` is given a tree."""

    @abstractmethod
    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """Write a file, which appears only when it is complete. The same splats give the same bytes.

        Args:
            path: Of the file, or of the folder for a format without suffix.
            table: In the frame that the file shall have, positions in float64 or float32; any number of splats.
            frame: That of the input, if the table is in it. Its shift is left out of the coordinates of formats of
                float32 or less (`SplatTable.file_means`); those that have a place for it name the shift, the coordinate
                system and the unit.
            tree: The same splats as tiles with levels of detail, in the same frame; for formats that want one.

        Raises:
            BadInput: A value is NaN or Inf (`SplatTable.refuse_unsound`), or the format has no place for such splats.
        """

    def read(self, path: Path) -> SplatTable:
        """The splats of a file, in any order, as `write` was given them but for the rounding of the format.

        Where files have other axes than PLY files, they are turned to those, and `SplatTable.axes` says from which.

        What is allocated is in proportion to the size of the file, whatever its header says.

        Raises:
            BadInput: Not such a file, damaged, or the format can be written only.
        """
        raise BadInput(f"{path}: files of the format {name_of(self)} are written, and not read")

    def knows(self, path: Path, head: bytes) -> bool:
        """Whether a file is of this format; `head` is what it begins with, up to HEAD bytes."""
        return False

    def kept(self, table: SplatTable) -> SplatTable:
        """Those of the splats that a file gets: all, but for formats with a limit, whose `write` tells of the rest."""
        return table

    def rounding(self, table: SplatTable) -> str:
        """What a file does not keep of such splats as it is, in one line for the user."""
        return ""
