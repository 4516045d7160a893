"""Streamed SOG, version 1: splats with levels of detail, of which PlayCanvas and SuperSplat load what a camera needs.

A folder with lod-meta.json, a binary tree of boxes. Each leaf of the tree has the same part of the scene in each level
of detail, level 0 the finest: a run of splats in a chunk, which is a SOG file that is not in an archive (`sog.py`).
Source: the Streamed SOG format in the user manual at developer.playcanvas.com.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from surfkit.core.check import require_within
from surfkit.core.codec import write_json
from surfkit.core.files import refuse_own, replacing_folder
from surfkit.core.version import own_version
from surfkit.io.splats.base import Format
from surfkit.io.splats.sog import SOG
from surfkit.io.splats.splat_table import SplatTable, Tile, joined
from surfkit.io.splats.tiles3d import box_of, divided
from surfkit.scene.morton import morton_order
from surfkit.scene.scene import Frame

LOD_INDEX = "lod-meta.json"
DIGITS = 7
"""Of numbers in the index that are not whole."""


@dataclass(frozen=True)
class StreamedSOG(Format):
    """A folder with lod-meta.json for PlayCanvas and SuperSplat: SOG in chunks and levels of detail, for large scenes
    on the web."""

    suffix: ClassVar[str] = ""
    wants_tree: ClassVar[bool] = True

    palette: int = 65_536
    """As in format:sog, for each chunk."""

    effort: int = 20
    """As in format:sog."""

    chunk_splats: int = 250_000
    """Most splats in a chunk, which is loaded as a whole; a larger part of the scene has a chunk of its own."""

    leaf_splats: int = 50_000
    """Most splats in a leaf of the tree, a part of the scene that has one level of detail at a time; only where the
    levels of detail of the run have larger ones."""

    def __post_init__(self) -> None:
        limits = {"chunk_splats": (1_000, 10_000_000), "leaf_splats": (1_000, 5_000_000)}
        require_within({"palette": (1, 65_536), "effort": (0, 100)} | limits, self)

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`. Replaces a folder that has a lod-meta.json, and no other folder."""
        path = Path(path)
        if path.is_dir() and any(path.iterdir()) and not (path / LOD_INDEX).is_file():
            raise OSError(errno.ENOTEMPTY, f"not empty and without {LOD_INDEX}; name another", str(path))
        refuse_own(path)
        table.refuse_unsound(path)
        whole = np.zeros((2, 3))
        root = divided(tree or Tile(table, *whole), self.leaf_splats)
        levels = levels_of(root)
        node = spread(root, {}, levels)
        with replacing_folder(path) as folder:
            names: list[str] = []
            counts = [self._write_level(folder, level, node, frame, names) for level in range(levels)]
            index = {
                "version": 1,
                "asset": {"generator": f"surfkit {own_version()}"},
                "count": sum(counts),
                "counts": counts,
                "lodLevels": levels,
                "lodErrors": True,
                "filenames": names,
                "tree": node.index(),
            }
            write_json(folder / LOD_INDEX, index)

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        return f"in each chunk, {SOG(self.palette).rounding(table)}"

    def _write_level(self, folder: Path, level: int, root: Node, frame: Frame | None, names: list[str]) -> int:
        """Write the chunks of a level, add their names, note in the leaves where their splats are; how many these
        are."""
        count, chunk = 0, list[tuple[Leaf, SplatTable]]()
        for leaf in root.leaves():
            if (splats := leaf.levels.get(level)) is None or not len(splats):
                continue
            splats = replace(splats, means=splats.file_means(frame)).on_cpu()
            if chunk and sum(len(some) for _, some in chunk) + len(splats) > self.chunk_splats:
                self._write_chunk(folder, level, chunk, frame, names)
                chunk = []
            chunk.append((leaf, splats.take(torch.from_numpy(morton_order(splats.means.double().numpy())))))
            count += len(splats)
        if chunk:
            self._write_chunk(folder, level, chunk, frame, names)
        return count

    def _write_chunk(
        self,
        folder: Path,
        level: int,
        runs: Sequence[tuple[Leaf, SplatTable]],
        frame: Frame | None,
        names: list[str],
    ) -> None:
        """Write runs of splats as a SOG file that is not in an archive."""
        table = joined([splats for _, splats in runs])
        name = f"{level}_{sum(other.startswith(f'{level}_') for other in names)}"
        (folder / name).mkdir()
        for file, data in SOG(self.palette, self.effort).files(table, np.arange(len(table)), frame):
            (folder / name / file).write_bytes(data)
        offset = 0
        for leaf, splats in runs:
            leaf.runs[level] = {"file": len(names), "offset": offset, "count": len(splats)}
            leaf.boxes.append(box_of(splats))
            offset += len(splats)
        names.append(f"{name}/meta.json")


class Leaf:
    """A part of the scene in all levels.

    Args:
        levels: Its splats, by level.
        errors: Of each level.
    """

    def __init__(self, levels: dict[int, SplatTable], errors: list[float]) -> None:
        self.levels, self.errors = levels, errors
        self.runs: dict[int, dict[str, int]] = {}
        """Where its splats are, by level."""
        self.boxes: list[np.ndarray] = []
        """(2, 3) corners of the boxes around them."""

    def leaves(self) -> Iterator[Leaf]:
        """Itself."""
        yield self

    @property
    def box(self) -> np.ndarray:
        """(2, 3) corners of the box around all its splats."""
        boxes = self.boxes or [np.zeros((2, 3))]
        return np.stack([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])

    def index(self) -> dict[str, Any]:
        """What lod-meta.json says of it."""
        runs = {str(level): run for level, run in sorted(self.runs.items())}
        return {"bound": _bound(self.box), "lods": runs, "errors": [_rounded(error) for error in self.errors]}


@dataclass(frozen=True)
class Branch:
    """Two parts of the scene."""

    halves: tuple[Node, Node]

    def leaves(self) -> Iterator[Leaf]:
        """All leaves, from left to right."""
        for half in self.halves:
            yield from half.leaves()

    @property
    def box(self) -> np.ndarray:
        """(2, 3) corners of the box around all splats."""
        one, other = (half.box for half in self.halves)
        return np.stack([np.minimum(one[0], other[0]), np.maximum(one[1], other[1])])

    def index(self) -> dict[str, Any]:
        """What lod-meta.json says of it."""
        return {"bound": _bound(self.box), "children": [half.index() for half in self.halves]}


Node = Leaf | Branch


def height_of(tile: Tile) -> int:
    """Levels of tiles below a tile, at most."""
    return 1 + max(map(height_of, tile.children)) if tile.children else 0


def levels_of(tile: Tile) -> int:
    """Levels of detail of a tree: tiles that draw nothing of their own are none."""
    below = max(map(levels_of, tile.children), default=1)
    return max(below, height_of(tile) + 1) if len(tile.splats) else below


def spread(tile: Tile, above: dict[int, tuple[SplatTable, float]], levels: int) -> Node:
    """A tile and what is below it, with the splats of coarser tiles divided among the leaves: each goes where its
    centre lies, or to the nearest box.

    Args:
        tile: The tile.
        above: Splats of coarser tiles that lie in it, with their errors, by level: the height of their tile.
        levels: In the whole tree.
    """
    own = dict(above)
    if len(tile.splats):
        own[height_of(tile)] = tile.splats, tile.error
    if not tile.children:
        return _leaf(own, levels)
    corners = np.stack([np.stack([child.low, child.high]) for child in tile.children])
    shares: list[dict[int, tuple[SplatTable, float]]] = [{} for _ in tile.children]
    for level, (splats, error) in own.items():
        to = nearest_box(splats.means.detach().cpu().double().numpy(), corners)
        for at, share in enumerate(shares):
            share[level] = splats.take(torch.from_numpy(to == at)), error
    below = [spread(child, share, levels) for child, share in zip(tile.children, shares, strict=True)]
    return _paired(below)


def _leaf(own: dict[int, tuple[SplatTable, float]], levels: int) -> Leaf:
    """A leaf that has something in each level: where a level is missing, as a tree is less deep there, the next finer
    one."""
    found, errors = dict[int, SplatTable](), list[float]()
    for level in range(levels):
        if level in own:
            found[level] = own[level][0]
        elif level:
            found[level] = found[level - 1]
        error = own[level][1] if level in own and level else 0.0
        errors.append(max([error, *errors]))
    return Leaf(found, errors)


def nearest_box(places: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(N,) the box that each of (N, 3) places is in, or is nearest to; of several the first.

    Args:
        places: (N, 3).
        corners: (B, 2, 3) lower and upper corners.
    """
    away = np.stack([np.linalg.norm(np.maximum(np.maximum(low - places, places - high), 0), axis=1)
                     for low, high in corners])  # fmt: skip
    return away.argmin(0)


def _paired(nodes: Sequence[Node]) -> Node:
    """A binary tree over some nodes, in their order."""
    if len(nodes) == 1:
        return nodes[0]
    half = len(nodes) // 2
    return Branch((_paired(nodes[:half]), _paired(nodes[half:])))


def _bound(box: np.ndarray) -> dict[str, list[float]]:
    return {"min": [_rounded(value) for value in box[0]], "max": [_rounded(value) for value in box[1]]}


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
