"""Lists of different lengths in PLY files: views beside the points of OpenMVS, and faces of any number of corners."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.io.splats.ply import PLY_TYPES, element_layout, open_header

LIST_PREFIX = "property list "


def has_lists(lines: Sequence[str]) -> bool:
    """Whether a PLY header begins with points that have lists."""
    return any(line.startswith(LIST_PREFIX) for line in _of_points(lines))


def points_beside_lists(path: Path, lines: Sequence[str]) -> np.ndarray:
    """(P,) records of what a point has before its first list, of a binary little-endian cloud.

    Rows differ in length, so one after the other is looked at: about half a second for a million points. They are in
    memory, without their lists.

    Args:
        path: The file.
        lines: Of its header, words one space apart.

    Raises:
        BadInput: Damaged, or the coordinates do not come first.
    """
    head, *own = _of_points(lines)
    first = next(i for i, line in enumerate(own) if line.startswith(LIST_PREFIX))
    if not {"x", "y", "z"} <= {line.split()[-1] for line in own[:first]}:
        raise BadInput(f"{path}: x, y and z of its points do not come before {own[first]!r}; leave that list out")
    _, count, dtype = element_layout(path, [head, *own[:first]])
    steps, found = _steps(path, own[first:]), bytearray()
    _, at, size = open_header(path)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for row in range(count):
            end = at + dtype.itemsize
            found += data[at:end]
            try:
                for step in steps:
                    end = step(data, end)
            except IndexError:
                end = size + 1
            if end > size:
                raise BadInput(f"{path}: cut off after {row} of {count} vertices; write or copy it again")
            at = end
    return np.frombuffer(found, dtype)


def fans(path: Path, triangle: np.dtype, start: int, count: int) -> np.ndarray:
    """(F, 3) triangles of the faces of a binary little-endian file, each a fan about its first corner.

    Rows differ in length, so one after the other is looked at: about half a second for a million faces.

    Args:
        path: The file.
        triangle: Of a face of three corners, with the fields "size" and "corners".
        start: Where the faces begin.
        count: How many there are.

    Raises:
        BadInput: Cut off, or a face with fewer than three corners.
    """
    fields, wide, three = triangle.fields, triangle["size"], triangle["corners"]
    assert fields is not None, "a face has named fields"
    at_size, at_corners = fields["size"][1], fields["corners"][1]
    each, corner = three.itemsize // 3, three.base
    data, at, rows, sizes = path.read_bytes(), start, np.empty(count, np.int64), np.empty(count, np.int64)
    for face in range(count):
        size = int.from_bytes(data[at + at_size : at + at_size + wide.itemsize], "little")
        rows[face], sizes[face] = at + at_corners, size
        at += triangle.itemsize + (size - 3) * each
        if size < 3 or at > len(data):
            what = "cut off" if size >= 3 else f"{size} corners"
            raise BadInput(f"{path}: face {face + 1} of {count}: {what}; write or copy the file again")
    plain, found = np.frombuffer(data, np.uint8), []
    for size in np.unique(sizes).tolist():
        bytes_of = rows[sizes == size, None] + np.arange(size * each)
        corners = plain[bytes_of].view(corner).reshape(-1, size).astype(np.int64)
        first = np.broadcast_to(corners[:, :1], (len(corners), size - 2))
        found.append(np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=2).reshape(-1, 3))
    return np.concatenate(found)


def _of_points(lines: Sequence[str]) -> list[str]:
    """The line of the first element and those of its properties, if these are points."""
    heads = [i for i, line in enumerate(lines) if line.startswith("element ")] + [len(lines)] * 2
    own = [line for line in lines[heads[0] : heads[1]] if line.startswith(("element ", "property "))]
    return own if own and own[0].startswith("element vertex ") else []


def _steps(path: Path, properties: Sequence[str]) -> list[Callable[[mmap.mmap, int], int]]:
    """Functions that give the place behind each property, from that before it."""
    steps: list[Callable[[mmap.mmap, int], int]] = []
    for word in (line.split() for line in properties):
        is_list = word[1] == "list"
        if len(word) != (5 if is_list else 3) or not {*word[1 + is_list : -1]} <= PLY_TYPES.keys():
            raise BadInput(f"{path}: cannot read {' '.join(word)!r} of a vertex; types: {', '.join(PLY_TYPES)}")
        sizes = [np.dtype(PLY_TYPES[name]) for name in word[1 + is_list : -1]]
        if is_list and sizes[0].kind == "f":
            raise BadInput(f"{path}: {' '.join(word)!r} counts its numbers with {word[2]}; write the file again")
        steps.append(_list_step(*sizes) if is_list else _step(sizes[0].itemsize))
    return steps


def _step(size: int) -> Callable[[mmap.mmap, int], int]:
    return lambda _, at: at + size


def _list_step(counted: np.dtype, of: np.dtype) -> Callable[[mmap.mmap, int], int]:
    wide, each = counted.itemsize, of.itemsize
    if wide == 1:
        return lambda data, at: at + 1 + data[at] * each
    return lambda data, at: at + wide + int.from_bytes(data[at : at + wide], "little") * each
