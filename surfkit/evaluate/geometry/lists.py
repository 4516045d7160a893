"""Points that have lists beside their coordinates, as the views of each point in the clouds of OpenMVS."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.export.ply import TYPES

LIST = "property list "


def has_lists(lines: Sequence[str]) -> bool:
    """Whether the first element of a PLY header, which is that of the points, has lists."""
    return any(line.startswith(LIST) for line in _of_points(lines))


def points_beside_lists(path: Path, lines: Sequence[str]) -> np.ndarray:
    """(P,) records of what a point has before its first list, of a binary little-endian cloud.

    Rows differ in length, so one after the other is looked at: about a second for a million points.

    Args:
        path: The file.
        lines: Of its header, words one space apart.

    Raises:
        BadInput: Damaged, or the coordinates do not come first.
    """
    own = _of_points(lines)
    first = next(i for i, line in enumerate(own) if line.startswith(LIST))
    dtype = np.dtype([(word[-1], _size(path, word[1])) for word in (line.split() for line in own[:first])])
    if not {"x", "y", "z"} <= set(dtype.names or ()):
        raise BadInput(f"{path}: x, y and z of its points do not come before {own[first]!r}; leave that list out")
    count, steps = int(lines[lines.index(own[0]) - 1].split()[2]), _steps(path, own[first:])
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(b"\n", data.find(b"end_header")) + 1
        found, size = bytearray(), len(data)
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


def _of_points(lines: Sequence[str]) -> list[str]:
    """Lines of the properties of the first element."""
    heads = [i for i, line in enumerate(lines) if line.startswith("element ")] + [len(lines)] * 2
    return [line for line in lines[heads[0] : heads[1]] if line.startswith("property ")]


def _steps(path: Path, properties: Sequence[str]) -> list[Callable[[mmap.mmap, int], int]]:
    """Functions that give the place behind each property, from that before it."""
    steps: list[Callable[[mmap.mmap, int], int]] = []
    for word in (line.split() for line in properties):
        if word[1] != "list":
            steps.append(lambda _, at, size=_size(path, word[1]).itemsize: at + size)
            continue
        wide, each = _size(path, word[2]), _size(path, word[3])
        if wide.kind == "f":
            raise BadInput(f"{path}: {' '.join(word)!r} counts its numbers with {word[2]}; write the file again")
        steps.append(_list_step(wide.itemsize, each.itemsize))
    return steps


def _list_step(wide: int, each: int) -> Callable[[mmap.mmap, int], int]:
    if wide == 1:
        return lambda data, at: at + 1 + data[at] * each
    return lambda data, at: at + wide + int.from_bytes(data[at : at + wide], "little") * each


def _size(path: Path, name: str) -> np.dtype:
    """A scalar of PLY."""
    if name not in TYPES:
        raise BadInput(f"{path}: cannot read numbers of type {name!r}; types: {', '.join(TYPES)}")
    return np.dtype("<" + TYPES[name])
