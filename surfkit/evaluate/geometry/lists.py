"""Points that have lists beside their coordinates, as the views of each point in the clouds of OpenMVS."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.export.ply import TYPES, element_layout, open_header

LIST = "property list "


def has_lists(lines: Sequence[str]) -> bool:
    """Whether a PLY header begins with points that have lists."""
    return any(line.startswith(LIST) for line in _of_points(lines))


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
    first = next(i for i, line in enumerate(own) if line.startswith(LIST))
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
        if len(word) != (5 if is_list else 3) or not {*word[1 + is_list : -1]} <= TYPES.keys():
            raise BadInput(f"{path}: cannot read {' '.join(word)!r} of a vertex; types: {', '.join(TYPES)}")
        sizes = [np.dtype(TYPES[name]) for name in word[1 + is_list : -1]]
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
