"""`.surfkit` files as one of the formats of splats: read wherever such a file is, and written from any other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from surfkit.compress.container import ModelFile, write_model
from surfkit.compress.index import CONTAINER_MAGIC
from surfkit.compress.packed import Packed
from surfkit.io.splats.base import Format
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.io.splats.splat_files import format_of, read_splat_file
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.primitives.model import SplatModel, primitive_of
from surfkit.scene.scene import Frame


@dataclass(frozen=True)
class SurfkitFile(Format):
    """surfkit's own: the smallest at the same quality; `surfkit compress` has its settings."""

    suffix: ClassVar[str] = ".surfkit"

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`."""
        model = model_of(table)
        here = None if frame is None else replace(frame, origin=np.zeros(3), scale=1.0)
        write_model(path, model, Packed().plan(model, None, 0), Packed(), here)

    def read(self, path: Path) -> SplatTable:
        """See `Format.read`."""
        file = ModelFile(path)
        model, _ = file.read()
        table = replace(model.primitive.table(model.params), means=model.params["means"])
        return table if file.frame is None else table.in_input_frame(file.frame)

    def knows(self, path: Path, head: bytes) -> bool:
        """See `Format.knows`."""
        return head.startswith(CONTAINER_MAGIC)


def model_of(table: SplatTable) -> SplatModel:
    """Splats of a file as a model in their own frame; positions stay float64 where they are."""
    primitive = primitive_of(table)
    params = primitive.from_table(table, torch.Generator().manual_seed(0))
    return SplatModel(primitive, params | {"means": table.means.contiguous()}, table.sh_degree)


def model_of_file(path: Path, axes: AxesOrAuto = "auto") -> tuple[SplatModel, Frame | None]:
    """The model in a file of splats of any format, and the frame that it lies in, if the file has one.

    Args:
        path: Of the file.
        axes: See `read_splat_file`.

    Raises:
        BadInput: No such file, of no known format, or damaged.
    """
    if axes == "auto" and isinstance(format_of(path), SurfkitFile):
        file = ModelFile(path)
        return file.read()[0], file.frame
    return model_of(read_splat_file(path, axes)), None
