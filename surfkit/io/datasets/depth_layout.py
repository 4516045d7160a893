"""What a layout of depth maps is, and which one a data set has."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from surfkit.core.registry import Component, components
from surfkit.io.datasets.depth_files import DepthFile


@dataclass(frozen=True)
class DepthQuery:
    """The data set whose depth maps are looked for.

    Attributes:
        root: Folder of the data set.
        names: Of the photographs, as the data set spells them.
        model: Folder of its sparse model; the data set itself where it has none.
        metres: Metres per unit of the data set; None where that is not known.
    """

    root: Path
    names: Sequence[str]
    model: Path
    metres: float | None = None


class DepthLayout(Component):
    """Where depth maps lie beside photographs, and what their numbers mean.

    Unless the user chooses one, layouts are asked in the order of their `priority`, the highest first and by name where
    it is the same; the first that finds files of its own is used. Of surfkit's, `estimated-depths` has priority 1, as
    `surfkit prepare depth` writes those maps; those of other programs have -1 and less.
    """

    priority: ClassVar[int] = 0

    @abstractmethod
    def find(self, query: DepthQuery) -> Mapping[str, DepthFile] | None:
        """The map of each photograph, by the photograph's name; None where the data set has no files of this layout.

        Files need not exist: photographs whose file does not are left out.

        Raises:
            BadInput: A file that describes the maps is damaged.
        """


def find_maps(query: DepthQuery, layout: DepthLayout | None = None) -> dict[str, DepthFile]:
    """The depth map of each photograph that has one, by name; empty where the data set has none.

    Args:
        query: The data set.
        layout: The one to use; None takes the first that finds something, see `DepthLayout`.

    Raises:
        BadInput: A file that describes the maps is damaged.
    """
    classes = sorted(components(DepthLayout).values(), key=lambda cls: -cls.priority)  # stable: by name where equal
    for each in (cls() for cls in classes) if layout is None else (layout,):
        if (found := each.find(query)) is not None:
            files = {name: found[name] for name in query.names if name in found}
            return {name: file for name, file in files.items() if file.path.is_file()}
    return {}
