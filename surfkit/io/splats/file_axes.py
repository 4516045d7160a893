"""Axes of files of splats, named as SPZ names them: where x, y and z point, such as rdf for right, down and forward.

Only the turn between two names means something. The numbers of a PLY file are rdf by the habit of 3DGS, and surfkit
takes them as those of the data set, whatever points up there. Names and numbers: CoordinateSystem in
src/cc/splat-types.h of nianticlabs/spz.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

Axes = Literal[
    "ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf", "lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu"
]  # fmt: skip
"""In the order of the numbers that SPZ gives them, from 1."""
AxesOrAuto = Literal["auto", Axes]
AXES_NAMES: tuple[Axes, ...] = get_args(Axes)
PLY_AXES: Axes = "rdf"
DIRECTION_WORDS = {"r": "right", "l": "left", "u": "up", "d": "down", "f": "forward", "b": "back"}
AXIS_DIRECTIONS = {"r": (1, 0, 0), "l": (-1, 0, 0), "u": (0, 1, 0), "d": (0, -1, 0), "f": (0, 0, -1), "b": (0, 0, 1)}


@dataclass(frozen=True)
class FileAxes:
    """The axes of the numbers in a file.

    Attributes:
        name: Of the axes.
        is_told: Whether the file says so, or all programs write such files in them; otherwise it is an assumption.
    """

    name: Axes
    is_told: bool = True


def turn_between(axes: Axes, to: Axes = PLY_AXES) -> np.ndarray:
    """(3, 3) matrix that gives coordinates along the axes `to` of those along `axes`; it mirrors where only one of the
    two is left-handed."""
    return _directions(to).T @ _directions(axes)


def in_words(axes: Axes) -> str:
    """Such as "right-down-forward"."""
    return "-".join(DIRECTION_WORDS[letter] for letter in axes)


def _directions(axes: Axes) -> np.ndarray:
    """(3, 3): each column is where an axis points."""
    return np.array([AXIS_DIRECTIONS[letter] for letter in axes], np.float64).T
