"""Sparse points that other programs keep as PLY files, binary or text."""

from __future__ import annotations

from itertools import chain, islice
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.io.splats.ply import read_vertices

COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) float64 positions and (P, 3) uint8 colours, grey where the file has none; points must be finite.

    Raises:
        BadInput: Not such a file, damaged, or without a finite point.
    """
    try:
        columns = _text(path) or _binary(path)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    if not {"x", "y", "z"} <= columns.keys():
        raise BadInput(f"{path}: no file of points: it lacks x, y or z")
    xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
    names = next((names for names in COLOR_NAMES if set(names) <= columns.keys()), None)
    rgb = np.full((len(xyz), 3), 128, np.uint8)
    if names is not None:
        values = np.stack([columns[name] for name in names], 1)
        scale = 255 if values.dtype.kind == "f" and values.max(initial=0) <= 1 else 1
        rgb = np.nan_to_num(values * scale).clip(0, 255).astype(np.uint8)
    with np.errstate(over="ignore"):
        finite = np.isfinite(xyz.astype(np.float32)).all(1)
    if not finite.any():
        raise BadInput(f"{path}: no point in it with finite coordinates; write the file again")
    if not finite.all():
        emit(Warned(f"{path}: {(~finite).sum()} of {len(xyz)} points without finite coordinates are left out"))
    return xyz[finite], rgb[finite]


def _binary(path: Path) -> dict[str, np.ndarray]:
    rows, _ = read_vertices(path)
    return {name: rows[name] for name in rows.dtype.names or ()}


def _text(path: Path) -> dict[str, np.ndarray]:
    """Columns of a text file; empty for a binary one."""
    with path.open("rb") as file:
        head = file.read(1 << 16).partition(b"end_header")[0].decode("ascii", "replace").split("\n")
    if "format ascii 1.0" not in (line.strip() for line in head):
        return {}
    words = [line.split() for line in head if line.strip()]
    elements = [row for row in words if row[0] == "element"]
    if not elements or elements[0][1:2] != ["vertex"] or len(elements[0]) != 3 or not elements[0][2].isdigit():
        raise BadInput(f"{path}: the first element is not vertex with a count; write the file again")
    begun = words.index(elements[0])
    ended = words.index(elements[1]) if len(elements) > 1 else len(words)
    properties = [row for row in words[begun:ended] if row[0] == "property"]
    if not all(len(row) == 3 for row in properties):
        raise BadInput(f"{path}: a property of the vertices that is no single number; write the file again")
    kinds = ["i8" if "char" in row[1] or "int" in row[1] else "f8" for row in properties]
    count = int(elements[0][2]) if len(elements[0][2]) < 19 else 0
    with path.open(encoding="latin-1", newline="\n") as file:
        lines = (line for line in islice(file, len(head), None) if line.strip())
        if not (first := list(islice(lines, 1))) or not count:
            raise BadInput(f"{path}: no points after its header; write or copy it again")
        try:
            rows = np.loadtxt(islice(chain(first, lines), count), np.float64, comments=None, ndmin=2)
        except ValueError as error:
            raise BadInput(f"{path}: not whole: {' '.join(str(error).split())}") from error
    if rows.shape != (count, len(properties)):
        raise BadInput(f"{path}: {rows.shape[0]} rows of {rows.shape[1]} numbers, not what its header says")
    with np.errstate(invalid="ignore"):  # a colour that is not finite
        columns = [rows[:, at].astype(kind) for at, kind in enumerate(kinds)]
    return {row[-1]: column for row, column in zip(properties, columns, strict=True)}
