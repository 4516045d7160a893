"""A textured mesh as 3D Tiles 1.1: what viewers of the globe stream.

Source: OGC 22-025r4, 3D Tiles 1.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.codec import write_json
from surfkit.export.gltf_reader import UPS
from surfkit.export.tileset import INDEX, box_json, ground_of, tileset
from surfkit.mesh.base import Mesh
from surfkit.scene.scene import Frame
from surfkit.texture.files import Part, write_textured_glb
from surfkit.texture.fill import Pictures
from surfkit.texture.regions import Region


@dataclass(frozen=True)
class Shape:
    """A textured mesh, page by page.

    Attributes:
        mesh: The mesh.
        parts: The triangles of each page.
        pages: The file of each page.
        tiles: The tile of each page.
        pictures: What the files are.
    """

    mesh: Mesh
    parts: Sequence[Part]
    pages: Sequence[Path]
    tiles: Sequence[int]
    pictures: Pictures


def write_tiles(folder: Path, shape: Shape, region: Region, frame: Frame, up: np.ndarray) -> None:
    """Write tileset.json and a GLB file for each tile.

    Args:
        folder: New.
        shape: What is written.
        region: The regions of the tiles.
        frame: Of the data set.
        up: (3, 3) from the frame of the input to z up, where it is not placed on Earth.
    """
    ground = ground_of(Path(folder.name), frame, up)  # not the folder that it is written in until it is whole

    def place(local: np.ndarray) -> np.ndarray:
        return ground.metres(frame.to_input(local))

    def written(part: Region) -> tuple[dict[str, Any], np.ndarray]:
        """The JSON of a tile and of all below it, and the (2, 3) corners of its box."""
        found: dict[str, Any] = {}
        if part.below:
            below = [written(half) for half in part.below]
            corners = np.stack([np.min([box[0] for _, box in below], 0), np.max([box[1] for _, box in below], 0)])
            error = float(np.linalg.norm(corners[1] - corners[0]))  # drawn by nothing: as far off as it is large
            found["children"] = [child for child, _ in below]
        else:
            pages = [at for at, tile in enumerate(shape.tiles) if tile == part.number]
            name = f"tiles/{part.number}.glb"
            parts, files = [shape.parts[at] for at in pages], [shape.pages[at] for at in pages]
            corners = write_textured_glb(folder / name, shape.mesh, parts, files, shape.pictures, place, UPS["z"])
            error = 0.0
            found["content"] = {"uri": name}
        return {"boundingVolume": box_json(corners), "geometricError": error, **found}, corners

    root, _ = written(region)
    write_json(folder / INDEX, tileset(root, ground.matrix))
