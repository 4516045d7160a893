"""Cameras that lie on a map: a file beside them says on which, and what their coordinates leave out."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.io.datasets.raw_dataset import RawDataset
from surfkit.scene.crs import known_axes

GEOREFERENCE_FILE = "georeference.json"
EPSG_PATTERN = re.compile(r"EPSG:\d{4,6}", re.IGNORECASE)


@dataclass(frozen=True)
class Georeference:
    """Coordinates on the map are those of the cameras plus the offset.

    Attributes:
        crs: Coordinate reference system, such as "EPSG:32633".
        offset: East, north and up, units of the map.
        metres_per_unit: Of the map; None is what its system says.
        vertical_crs: What heights are above, such as "EPSG:5773" (EGM96), where `crs` does not say it.
    """

    crs: str
    offset: tuple[float, float, float]
    metres_per_unit: float | None = None
    vertical_crs: str | None = None

    def __post_init__(self) -> None:
        if (
            not self.crs
            or not np.isfinite(self.offset).all()
            or not (self.metres_per_unit is None or 0 < self.metres_per_unit < np.inf)
        ):
            raise BadInput("crs must name a system, offset and metres_per_unit must be finite numbers")
        if self.vertical_crs is not None and not (
            EPSG_PATTERN.fullmatch(self.crs) and EPSG_PATTERN.fullmatch(self.vertical_crs)
        ):
            raise BadInput(
                f"vertical_crs is {self.vertical_crs!r} and crs {self.crs!r}; with a vertical_crs, both must be codes "
                "such as EPSG:5773 and EPSG:32633"
            )

    @property
    def system(self) -> str:
        """The coordinate reference system with what heights are above, such as "EPSG:32633+5773"."""
        return self.crs if self.vertical_crs is None else f"{self.crs}+{self.vertical_crs.partition(':')[2]}"


def read_placed(*folders: Path) -> Georeference | None:
    """Where the cameras lie by the file in one of some folders; None if no file says so.

    Raises:
        BadInput: A file is damaged, or two of them differ.
    """
    paths = [path for path in dict.fromkeys(folder / GEOREFERENCE_FILE for folder in folders) if path.is_file()]
    found = [read_json(path, Georeference) for path in paths]
    if other := next((path for path, placed in zip(paths, found, strict=True) if placed != found[0]), None):
        raise BadInput(f"{paths[0]} and {other} differ; delete the one that is wrong")
    return found[0] if found else None


def on_the_map(capture: RawDataset, placed: Georeference) -> RawDataset:
    """A capture in the coordinates of the map."""
    offset, metres = np.array(placed.offset), placed.metres_per_unit
    if metres is None and (axes := known_axes(placed.system)) is not None:
        metres = axes.metres
    shots = []
    for shot in capture.shots:
        pose = shot.pose.copy()
        pose[:3, 3] -= pose[:3, :3] @ offset
        shots.append(replace(shot, pose=pose))
    return replace(
        capture,
        shots=shots,
        xyz=capture.xyz + offset,
        metres=metres,
        crs=placed.system,
        shift=placed.offset if any(placed.offset) else capture.shift,
    )
