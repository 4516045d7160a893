"""RealityCapture and RealityScan: a CSV file of "Internal/External camera parameters", a photograph a line.

RealityScan's own templates of exports (calibration.xml) say what the numbers mean: f is in millimetres of a film 36 mm
wide, px and py are shares of the longer side, from the middle, and OpenCV's p1 and p2 are t2 and t1. Angles are those
of an aircraft whose camera looks down, the top of the picture to its nose: heading from north to east, pitch nose up,
roll right wing down.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import Brown, LensTable
from surfkit.io.datasets.camera_files import numbers, one_file, photographs, pose_at, read_text
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.transforms import points
from surfkit.scene.photos import photo_size

FILM_MM = 36.0
CSV_COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
NEWER_COLUMNS = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""What RealityScan calls columns of RealityCapture."""
MIN_HORIZONTAL_RATIO = 0.02
"""Of the range of heights: a smaller range of x and y is probably one of degrees."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""From x right, y up, z backward to x right, y down, z forward."""


@dataclass(frozen=True)
class RealityCapture(Reader):
    """RealityCapture: the CSV file of its internal and external camera parameters, and images/."""

    def recognises(self, root: Path) -> bool:
        return bool(_files(root))

    def read(self, data: Data) -> RawDataset:
        path = one_file(data.path, _files(data.path), "CSV file of 'Internal/External camera parameters'; export it")
        rows = _rows(path)
        found = photographs(data, [row["name"] for row in rows])
        shots: list[RawImage] = []
        lenses = LensTable(path)
        for row in rows:
            if row["name"] in found:
                with leaving_out():
                    shots.append(_shot(path, row, found[row["name"]], lenses))
        lenses.tell()
        _tell_degrees(path, shots)
        return RawDataset(shots, *points(data.path, {}))


def _files(root: Path) -> list[Path]:
    """The CSV files of a folder that begin as those of cameras do."""
    return sorted(path for path in root.glob("*.csv") if path.is_file() and _is_headed(path))


def _is_headed(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            line = file.readline(1000).decode("utf-8-sig", "replace")
    except OSError:
        return False
    return line.startswith("#name,") and {"x", "y", "alt", "pitch", "roll"} <= set(_columns(line))


def _columns(line: str) -> list[str]:
    words = [word.strip() for word in line.strip().removeprefix("#").split(",")]
    return [NEWER_COLUMNS.get(word, word) for word in words]


def _rows(path: Path) -> list[dict[str, str]]:
    """The photographs: text by column."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    columns = _columns(lines[0])
    if lacking := [name for name in CSV_COLUMNS if name not in columns]:
        raise BadInput(
            f"{path}: it lacks {', '.join(lacking)}; export it as 'Internal/External camera parameters' again"
        )
    rows = []
    try:
        split = list(csv.reader(lines[1:]))
    except csv.Error as error:
        raise BadInput(f"{path}: no table of values with commas between: {error}; export the file again") from error
    for at, words in enumerate(split, 2):
        if len(words) != len(columns):
            raise BadInput(f"{path}: line {at} has {len(words)} values, not {len(columns)}; export the file again")
        rows.append(dict(zip(columns, (word.strip() for word in words), strict=True)))
        rows[-1]["name"] = rows[-1]["name"].replace("\\", "/").rpartition("/")[2]
    if not rows:
        raise BadInput(f"{path}: no photograph in it; align them, and export the file again")
    return rows


def _shot(path: Path, row: Mapping[str, str], photo: Path, lenses: LensTable) -> RawImage:
    where = f"{path}: {row['name']}"
    given = numbers(where, [row[name] for name in CSV_COLUMNS[1:]], len(CSV_COLUMNS) - 1).tolist()
    value = dict(zip(CSV_COLUMNS[1:], given, strict=True))
    width, height = photo_size(photo)
    longer = max(width, height)
    focal, centre = value["f"] / FILM_MM * longer, (value["px"] * longer + width / 2, value["py"] * longer + height / 2)
    radial = (value["k1"], value["k2"], value["k3"], value["k4"])
    lens = lenses.camera(where, Brown((width, height), (focal, focal), centre, radial, (value["t2"], value["t1"])))
    axes = _turn(2, -value["heading"]) @ _turn(0, value["pitch"]) @ _turn(1, value["roll"])  # camera to world
    place = np.array([value["x"], value["y"], value["alt"]])
    return RawImage(row["name"], pose_at(where, OPENGL_TO_OPENCV @ axes.T, place), lens, photo)


def _tell_degrees(path: Path, shots: Sequence[RawImage]) -> None:
    """A warning if positions look like longitudes and latitudes: the file does not say what they are."""
    if len(shots) < 2:
        return
    centres = np.stack([-shot.pose[:3, :3].T @ shot.pose[:3, 3] for shot in shots])
    east, north, up = np.ptp(centres, axis=0)
    if (np.abs(centres[:, :2]) <= (180, 90)).all() and max(east, north) < MIN_HORIZONTAL_RATIO * up:
        emit(
            Warned(
                f"{path}: x and y differ by {max(east, north):.2g} and heights by {up:.2g}: if these are degrees, "
                "export in a projected or a local coordinate system"
            )
        )


def _turn(axis: int, degrees: float) -> np.ndarray:
    """(3, 3) rotation about an axis, right-handed."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn[a, a], turn[a, b], turn[b, a], turn[b, b] = c, -s, s, c
    return turn
