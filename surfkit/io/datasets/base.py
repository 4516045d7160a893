"""What a reader is: a layout of data sets, and what the numbers in their files mean."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar

from surfkit.core.registry import Component
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawDataset, Tracks


class Reader(Component):
    """A layout of data sets: what lies where, and what the numbers mean.

    Of several readers that recognise a folder, the one of highest `priority` reads it; if two share the highest, the
    user must choose with --layout.
    """

    priority: ClassVar[int] = 0

    @abstractmethod
    def recognises(self, root: Path) -> bool:
        """Whether a folder looks like this layout, whole or damaged."""

    @abstractmethod
    def read(self, data: Data) -> RawDataset:
        """What is in the folder `data.path`.

        What is wrong with one photograph, or can be gone on after, goes through `core.check.reject` or `leaving_out`:
        so `surfkit doctor` finds everything that is wrong at once.

        Raises:
            BadInput: Something is missing or damaged; one line says what to do.
        """

    def model_folder(self, data: Data) -> Path | None:
        """Folder of the sparse model, where the layout has one with observations; None where it has none."""
        return None

    def tracks(self, data: Data) -> Tracks | None:
        """The observations of the sparse model; None where the layout has none."""
        return None
