"""Splats as 3D Tiles 1.1, placed on Earth and with levels of detail: what viewers of the globe stream.

Sources: OGC 22-025r4, 3D Tiles 1.1; its extension 3DTILES_content_gltf (github.com/CesiumGS/3d-tiles, extensions), by
which CesiumJS recognises splats before it loads a tile; tilesets of Cesium ion in the tests of CesiumJS 1.145.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from surfkit.core.check import BadInput, require_within
from surfkit.core.codec import write_json
from surfkit.core.files import refuse_own, replacing_folder
from surfkit.io.splats.base import Format
from surfkit.io.splats.gltf import Compress, Up, extensions_of, up_of, write_splats
from surfkit.io.splats.gltf_reader import UPS, read_splats
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.spz import SPZ
from surfkit.io.splats.tileset import INDEX, box_json, ground_of, tileset
from surfkit.scene.rotations import numpy_rotations
from surfkit.scene.scene import Frame

BOX_SIGMAS = 3.0
"""Standard deviations of a splat that the box of a tile contains; viewers draw no more."""
REFINE_ERROR_PX = 16.0
"""Geometric errors of as many pixels or more make viewers refine, by default."""
CONTENT = "3DTILES_content_gltf"


@dataclass(frozen=True)
class Tiles3D(Format):
    """A folder with tileset.json for CesiumJS and other viewers that stream large scenes over the web."""

    suffix: ClassVar[str] = ""
    wants_tree: ClassVar[bool] = True

    compress: Compress = "spz"
    """spz packs each tile as SPZ, the only splats that CesiumJS draws today; none keeps float32."""

    georeference: bool = True
    """Place the tiles on Earth, where the data set has a coordinate reference system."""

    up: Up = "auto"
    """Axis of the input that points up, or down with a minus. auto: z of a georeferenced data set, -y otherwise."""

    geoid: str = ""
    """The geoid that heights are above: a grid (GTX, GeoTIFF), or the metres by which it lies above the ellipsoid.
    By default they are above what the coordinate reference system says, and without a vertical part the ellipsoid."""

    most_splats: int = 200_000
    """Most splats in a tile; full-detail tiles with more are divided."""

    error_px: float = 1.0
    """Error of a coarse tile in pixels above which viewers take the finer ones, at their own default threshold
    (maximumScreenSpaceError 16 of CesiumJS). Smaller values make them load finer tiles earlier."""

    def __post_init__(self) -> None:
        require_within({"most_splats": (1_000, 5_000_000), "error_px": (0.01, 1000.0)}, self)

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`. Replaces a tileset of the same name, and no other folder."""
        path = Path(path)
        if path.is_dir() and any(path.iterdir()) and not (path / INDEX).is_file():
            raise OSError(errno.ENOTEMPTY, f"not empty and without {INDEX}; name another", str(path))
        refuse_own(path)
        table.refuse_unsound(path)
        place = self._place(path, frame)
        root = tree or Tile(table, *_corners(table))
        with replacing_folder(path) as folder:
            tiles = divided(root, self.most_splats)
            written, _ = _written(folder, tiles, "0", place, self.compress)
            write_json(folder / INDEX, self._index(written, place))

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        if self.compress == "spz":
            return SPZ(version=2).rounding(table)
        return "nothing is rounded but positions, to float32"

    def _place(self, path: Path, frame: Frame | None) -> TileOrigin:
        """From the coordinates of the table to metres in a tileset, and from there to Earth."""
        turn = UPS["z"].T @ UPS[up_of(self.up, frame)]
        ground = ground_of(path, frame, turn, self.georeference, self.geoid or None)

        def moved(table: SplatTable) -> SplatTable:
            means = torch.from_numpy(ground.metres(table.means.detach().cpu().double().numpy()))
            return replace(table, means=means, log_scales=table.log_scales + float(np.log(ground.unit)))

        return TileOrigin(moved, ground.unit * REFINE_ERROR_PX / self.error_px, ground.matrix, ground.notes)

    def _index(self, root: dict[str, Any], place: TileOrigin) -> dict[str, Any]:
        """The JSON of a tileset."""
        names = {"extensionsUsed": extensions_of(self.compress)}
        if self.compress == "spz":
            names["extensionsRequired"] = extensions_of(self.compress)
        return tileset(root, place.matrix, place.notes, extensionsUsed=[CONTENT], extensions={CONTENT: names})


@dataclass(frozen=True)
class TileOrigin:
    """Where the tiles lie.

    Attributes:
        moved: Splats about the origin of the tileset, metres, of splats as they were given.
        error: Geometric error, metres, per error of a tile as given.
        matrix: (4, 4) from the tileset to ECEF, or to z up.
        notes: What is doubtful of their place on Earth.
    """

    moved: Callable[[SplatTable], SplatTable]
    error: float
    matrix: np.ndarray
    notes: tuple[str, ...] = ()


def _written(
    folder: Path, tile: Tile, name: str, place: TileOrigin, compress: Compress
) -> tuple[dict[str, Any], np.ndarray]:
    """Write the splats of a tile and of all below it; its JSON, and the (2, 3) corners of its box."""
    below = [
        _written(folder, child, f"{name}-{at}", place, compress) for at, child in enumerate(tile.children)
    ]  # fmt: skip
    boxes = [box for _, box in below]
    found: dict[str, Any] = {}
    if len(tile.splats):
        tile.splats.refuse_unsound(f"tile {name}")
        file = folder / "tiles" / f"{name}.glb"
        write_splats(file, place.moved(tile.splats), UPS["z"], compress, {"up": "z"})
        boxes.append(box_of(read_splats(file)))  # as the file has them: rounded
        found["content"] = {"uri": f"tiles/{name}.glb"}
    low = np.min([box[0] for box in boxes], axis=0) if boxes else np.zeros(3)
    high = np.max([box[1] for box in boxes], axis=0) if boxes else np.zeros(3)
    half = (high - low) / 2
    error = max([tile.error * place.error, *(child["geometricError"] for child, _ in below)])
    if below and not len(tile.splats):  # seen from afar, it would be nothing: as far off as it is large
        error = max(error, float(2 * np.linalg.norm(half)))
    found |= {"boundingVolume": box_json(np.stack([low, high])), "geometricError": error}
    if below:
        found["children"] = [child for child, _ in below]
    return found, np.stack([low, high])


def box_of(table: SplatTable) -> np.ndarray:
    """(2, 3) corners of the box about all splats, `BOX_SIGMAS` standard deviations around each."""
    turns = torch.from_numpy(numpy_rotations(table.quats.numpy()))
    reach = BOX_SIGMAS * (turns * table.ellipsoid_log_scales().double().exp()[:, None]).norm(dim=2)
    means = table.means.double()
    return np.stack([(means - reach).amin(0).numpy(), (means + reach).amax(0).numpy()])


def divided(tile: Tile, most: int) -> Tile:
    """The same tree without leaves of more than `most` splats.

    Raises:
        BadInput: A tile above others has more: the levels of detail must be built with smaller tiles.
    """
    if not tile.children:
        parts = list(_halved(tile, most))
        return (
            parts[0] if len(parts) == 1 else replace(tile, splats=tile.splats.take(slice(0, 0)), children=tuple(parts))
        )
    if len(tile.splats) > most:
        raise BadInput(
            f"a tile of a coarse level has {len(tile.splats)} splats; most_splats is {most}: raise it, or build the "
            "levels of detail with smaller tiles"
        )
    children = [divided(child, most) for child in tile.children]
    flat = [part for child in children for part in (child.children if _is_group(child) else [child])]
    return replace(tile, children=tuple(flat))


def _is_group(tile: Tile) -> bool:
    """Whether it draws nothing of its own, so that its children can hang where it does."""
    return bool(tile.children) and not len(tile.splats)


def _halved(tile: Tile, most: int) -> Iterator[Tile]:
    """A leaf, or the halves of its halves along their longest sides."""
    if len(tile.splats) <= most:
        yield tile
        return
    means = tile.splats.means
    axis = int((means.amax(0) - means.amin(0)).argmax())
    order = means[:, axis].argsort(stable=True)
    for rows in order.tensor_split(2):
        splats = tile.splats.take(rows.sort().values)
        low, high = _corners(splats)
        yield from _halved(replace(tile, splats=splats, low=low, high=high), most)


def _corners(table: SplatTable) -> tuple[np.ndarray, np.ndarray]:
    if not len(table):
        return np.zeros(3), np.zeros(3)
    low, high = torch.aminmax(table.means.detach().cpu().double(), dim=0)
    return low.numpy(), high.numpy()
