"""Cloud Optimized Point Clouds (COPC 1.0): a LAZ 1.4 file whose chunks are the nodes of an octree, so that a viewer
reads only what it shows.

A node of level l is a cube, the root cut into 2^l along each axis. It is cut into SPAN cells along each axis, and has
the first point in each of these cells, in Z-order, that no node above has: all levels down to l together have one point
in each occupied cell. Points that come sorted tell their levels by the point before them alone. Nodes are written where
their cubes end, so memory holds one open node for each level. Source: specification of COPC 1.0, copc.io.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from surfkit.apps.maps.sorted_points import KEY_BITS, SortedPoints
from surfkit.apps.maps.surface_model import COLOR_CHANNELS

POINT_SOURCE_ID = 1
"""Point source ID: points of the mesh."""
ONLY_RETURN = 0x11
"""The first return of one, as the bit field of a record."""

SPAN_BITS = 7
SPAN = 1 << SPAN_BITS
"""Cells along each side of a node, as most writers have: level ground fills SPAN^2 of them."""
MAX_DEPTH = KEY_BITS - SPAN_BITS
INFO = "<5d2Q2d88x"
"""Centre of the root, half its side, its spacing, place and size of the hierarchy, first and last GPS time."""
ENTRY = np.dtype([("key", "<i4", 4), ("offset", "<u8"), ("bytes", "<i4"), ("points", "<i4")])
"""Of a node in the hierarchy: level, x, y, z, and where its chunk is."""
EVLR_HEADER = "<H16sHQ32s"
CHUNK_TABLE_POINTER_BYTES = 8
"""Of the place of LAZ's table of chunks, before the first one."""


@dataclass(frozen=True)
class Octree:
    """The cube of the root, in steps of the coordinates of the file.

    Attributes:
        low: (3,) int64, its lowest corner.
        side: Of the cube; a multiple of 2^depth, so that borders of nodes are whole steps.
        depth: Level of the smallest nodes.
    """

    low: np.ndarray
    side: int
    depth: int

    @classmethod
    def around(cls, low: np.ndarray, high: np.ndarray, spacing: float) -> Octree:
        """The octree of points on a surface, so far apart, between two (3,) int64 corners; all in steps."""
        extent = int((high - low).max()) + 1
        depth = min(max(0, math.floor(math.log2(extent / (SPAN * spacing)))), MAX_DEPTH)  # cells of 1 to 2 spacings
        return cls(low, -(-extent >> depth) << depth, depth)

    def levels(self, keys: np.ndarray, before: int | None) -> np.ndarray:
        """(n,) levels of points with sorted Z-order keys (n,) uint64; `before` is the key of the point before them."""
        changed = keys ^ np.concatenate([[keys[0] if before is None else np.uint64(before)], keys[:-1]])
        alike = KEY_BITS - np.searchsorted(8 ** np.arange(KEY_BITS, dtype=np.uint64), changed, side="right")
        if before is None:
            alike[0] = 0
        return (alike + 1 - SPAN_BITS).clip(0, self.depth)


@dataclass(frozen=True)
class Node:
    """A node with its points.

    Attributes:
        level: 0 is the root.
        number: Along the Z-order curve of its level.
        points: (n,) POINT.
    """

    level: int
    number: int
    points: np.ndarray

    @property
    def end(self) -> tuple[int, int]:
        """Where along the finest curve it ends; of nodes that end at one place, the smaller is first."""
        return (self.number + 1) << 3 * (KEY_BITS - self.level), -self.level

    @property
    def key(self) -> tuple[int, int, int, int]:
        """Level, x, y and z."""
        cell = [sum((self.number >> 3 * bit + axis & 1) << bit for bit in range(self.level)) for axis in range(3)]
        return self.level, cell[0], cell[1], cell[2]


def nodes_of(octree: Octree, batches: Iterable[tuple[np.ndarray, np.ndarray]]) -> Iterator[list[Node]]:
    """The nodes of points that come in Z-order, as pairs of (n,) keys and (n,) POINT: those that are finished after
    each batch, in an order that does not depend on the batches."""
    open_nodes: dict[int, list[Node]] = {}
    before = None
    for keys, points in batches:
        levels = octree.levels(keys, before)
        before, done = int(keys[-1]), []
        for level in range(octree.depth + 1):
            rows = np.flatnonzero(levels == level)
            numbers = keys[rows] >> np.uint64(3 * (KEY_BITS - level)) if level else np.zeros(len(rows), np.uint64)
            cuts = np.flatnonzero(np.diff(numbers)) + 1
            parts = [Node(level, int(numbers[part[0]]), points[rows[part]]) for part in
                     np.split(np.arange(len(rows)), cuts) if len(part)]  # fmt: skip
            waiting = open_nodes.get(level, []) + parts
            done += [node for node in waiting if node.end[0] <= before]
            open_nodes[level] = [node for node in waiting if node.end[0] > before]
        yield _whole(done)
    yield _whole([node for nodes in open_nodes.values() for node in nodes])


def _whole(parts: list[Node]) -> list[Node]:
    """The nodes that parts belong to, in the order of the file."""
    found: dict[tuple[int, int], list[Node]] = {}
    for part in parts:
        found.setdefault(part.end, []).append(part)
    return [
        Node(nodes[0].level, nodes[0].number, np.concatenate([node.points for node in nodes]))
        for _, nodes in sorted(found.items(), key=lambda each: each[0])
    ]


def write_copc(file: BinaryIO, header: Any, octree: Octree, points: SortedPoints) -> None:
    """Write points.

    Args:
        file: Empty; for reading and writing.
        header: A `laspy.LasHeader` of point format 6 or 7 with scales, offsets and the coordinate reference system.
        octree: Around all points.
        points: Steps of the scales from the offsets.
    """
    import laspy
    import lazrs

    layout = lazrs.LazVlr.new_for_compression(header.point_format.id, 0, True)
    info = laspy.VLR("copc", 1, "COPC info", bytes(struct.calcsize(INFO)))
    laszip = laspy.VLR("laszip encoded", 22204, "", bytes(layout.record_data()))
    header.vlrs[:] = [info, *header.vlrs, laszip]  # info must be the first
    header.are_points_compressed, header.number_of_evlrs = True, 1
    header.write_to(file)
    compressor = lazrs.ParLasZipCompressor(file, layout)
    compressor.reserve_offset_to_chunk_table()
    entries, corners = [], []
    for nodes in nodes_of(octree, points.batches()):
        compressor.compress_chunks([_records(header, node.points) for node in nodes])
        entries += [(node.key, 0, 0, len(node.points)) for node in nodes]
        corners += [corner(node.points["place"], 0) for node in nodes for corner in (np.min, np.max)]
    compressor.done()
    header.start_of_first_evlr = file.seek(0, io.SEEK_END)
    file.seek(header.offset_to_point_data)
    sizes = np.array([size for _, size in lazrs.read_chunk_table(file, layout)], np.int64)
    table = np.array(entries or [((0, 0, 0, 0), 0, 0, 0)], ENTRY)
    if entries:
        table["offset"] = header.offset_to_point_data + CHUNK_TABLE_POINTER_BYTES + np.cumsum(sizes) - sizes
        table["bytes"] = sizes
    table = table[np.lexsort(table["key"].T[::-1])]
    file.seek(header.start_of_first_evlr)
    file.write(struct.pack(EVLR_HEADER, 0, b"copc", 1000, table.nbytes, b"EPT hierarchy"))
    hierarchy = file.tell()
    file.write(table.tobytes())
    half = octree.side * header.scales[0] / 2
    center = octree.low * header.scales + header.offsets + half
    info.record_data = struct.pack(INFO, *center, half, 2 * half / SPAN, hierarchy, table.nbytes, 0.0, 0.0)
    header.point_count = header.number_of_points_by_return[0] = int(table["points"].sum())
    if corners:
        header.mins = np.min(corners, 0) * header.scales + header.offsets
        header.maxs = np.max(corners, 0) * header.scales + header.offsets
    file.seek(0)
    header.write_to(file, ensure_same_size=True)


def _records(header: Any, points: np.ndarray) -> bytes:
    """Point records of (n,) POINT."""
    records = np.zeros(len(points), header.point_format.dtype())
    for axis, name in enumerate("XYZ"):
        records[name] = points["place"][:, axis]
    records["bit_fields"], records["point_source_id"] = ONLY_RETURN, POINT_SOURCE_ID
    records["classification"] = points["kind"]
    if COLOR_CHANNELS[0] in records.dtype.names:
        for channel, name in enumerate(COLOR_CHANNELS):
            records[name] = points["color"][:, channel].astype(np.uint16) * 257
    return records.tobytes()
