"""A layout of data sets: photographs, a table of their cameras, and a table of sparse points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from surfkit.plugin import BadInput, RawDataset, Data, Reader, RawImage, camera_of, leaving_out

TABLE = "new-part.csv"
"""A line for each photograph: its name, width and height in pixels, fx, fy, cx, cy, and the twelve numbers of the first
three rows of world_to_camera (OpenCV axes), row by row."""
POINTS = "points.csv"
"""A line for each sparse point: x, y, z, red, green, blue. The file may be missing."""


@dataclass(frozen=True)
class NewPart(Reader):
    """Photographs in images/ whose cameras stand in new-part.csv, and sparse points in points.csv."""

    def recognises(self, root: Path) -> bool:
        """See `Reader.recognises`."""
        return (root / TABLE).is_file()

    def read(self, data: Data) -> RawDataset:
        """See `Reader.read`."""
        shots = []
        for number, line in enumerate(_lines(data.path / TABLE), 1):
            with leaving_out():  # what is wrong with one photograph is told, and the others are read
                shots.append(_shot(f"{data.path / TABLE}, line {number}", line, data.path / (data.images or "images")))
        points = data.path / POINTS
        rows = [_numbers(f"{points}, line {at}", line, 6) for at, line in enumerate(_lines(points), 1)]
        table = np.array(rows).reshape(-1, 6)
        return RawDataset(shots, table[:, :3], table[:, 3:].clip(0, 255).astype(np.uint8))


def _lines(path: Path) -> list[str]:
    """The lines of a file; none where there is no file."""
    return path.read_text(encoding="utf-8").splitlines() if path.is_file() else []


def _shot(where: str, line: str, images: Path) -> RawImage:
    name, _, rest = line.partition(",")
    values = _numbers(where, rest, 18)
    if not (images / name).is_file():
        raise BadInput(f"{where}: no photograph {name!r} in {images}; put it there, or delete the line")
    pose = np.eye(4)
    pose[:3] = np.reshape(values[6:], (3, 4))
    camera = camera_of(where, "PINHOLE", (int(values[0]), int(values[1])), values[2:6])
    return RawImage(name, pose, camera, images / name)


def _numbers(where: str, text: str, count: int) -> list[float]:
    """Finite numbers with commas between them."""
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise BadInput(f"{where}: {error}; give numbers with commas between them") from error
    if len(values) != count or not np.isfinite(values).all():
        raise BadInput(f"{where}: {len(values)} numbers; give {count} finite ones")
    return values
