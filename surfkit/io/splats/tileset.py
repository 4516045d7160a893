"""What all tilesets of 3D Tiles 1.1 have: their place on Earth, boxes, and tileset.json.

Source: OGC 22-025r4, 3D Tiles 1.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.version import own_version
from surfkit.scene.crs import refuse_other_unit
from surfkit.scene.earth import LocalEarthFrame
from surfkit.scene.geoid import geoid_of
from surfkit.scene.scene import Frame

INDEX = "tileset.json"


@dataclass(frozen=True)
class TilesetPlacement:
    """Where a tileset lies.

    Attributes:
        metres: (P, 3) float64 metres about the origin of the tileset, of (P, 3) coordinates in the frame of the input.
        unit: Metres per unit of these.
        matrix: (4, 4) from the tileset to ECEF, or to z up.
        notes: What is doubtful of its place on Earth.
    """

    metres: Callable[[np.ndarray], np.ndarray]
    unit: float
    matrix: np.ndarray
    notes: tuple[str, ...] = ()


def ground_of(
    path: Path, frame: Frame | None, turn: np.ndarray, georeference: bool = True, geoid: str | None = None
) -> TilesetPlacement:
    """The place of a tileset: on Earth, if the data set has a coordinate reference system, else about its centre.

    Args:
        path: For messages.
        frame: Of the data set, if one is known.
        turn: (3, 3) from the input to z up, where it is not placed on Earth.
        georeference: Whether to place it on Earth.
        geoid: What heights are above, see `geoid_of`; None leaves it to the coordinate reference system.

    Raises:
        BadInput: The coordinate reference system has no place for it, or contradicts the unit of the data set.
    """
    site = site_of(frame, geoid) if georeference else None
    if site is not None:
        for note in site.notes:
            emit(Warned(note))
        return TilesetPlacement(site.local, site.unit, site.pose, site.notes)
    if georeference:
        emit(
            Warned(
                f"{path}: the data set has no coordinate reference system, so the tiles have no place on Earth; "
                "viewers show them about its centre"
            )
        )
    unit, shift = (frame.metres if frame else None) or 1.0, frame.shift if frame else (0.0, 0.0, 0.0)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    return TilesetPlacement(lambda xyz: (xyz - np.array(shift)) * unit, unit, matrix)


def site_of(frame: Frame | None, geoid: str | None = None) -> LocalEarthFrame | None:
    """Where on Earth the scene of a data set lies; None if it has no coordinate reference system.

    Args:
        frame: Of the data set, if one is known.
        geoid: What heights are above, see `geoid_of`.

    Raises:
        BadInput: The coordinate reference system has no place for it, or contradicts the unit of the data set.
    """
    if frame is None or not frame.crs:
        if geoid is not None:
            raise BadInput(f"--geoid {geoid}: the data set has no coordinate reference system; leave it out")
        return None
    refuse_other_unit(frame.crs, frame.metres, frame.origin)
    return LocalEarthFrame.at(frame.crs, frame.origin, None if geoid is None else geoid_of(geoid))


def box_json(corners: np.ndarray) -> dict[str, Any]:
    """The bounding volume of (2, 3) lowest and highest coordinates."""
    (low, high) = corners
    return {"box": [*((low + high) / 2).tolist(), *np.diag((high - low) / 2).ravel().tolist()]}


def tileset(root: dict[str, Any], matrix: np.ndarray, notes: Sequence[str] = (), **more: Any) -> dict[str, Any]:
    """The JSON of a tileset.

    Args:
        root: The root tile, with a box.
        matrix: (4, 4) see `TilesetPlacement`.
        notes: The same; `asset.extras.notes`.
        more: Other members of the JSON.
    """
    if not np.array_equal(matrix, np.eye(4)):
        root = {**root, "transform": matrix.T.ravel().tolist()}
    extras = {"generator": f"surfkit {own_version()}"} | ({"notes": list(notes)} if notes else {})
    halves = np.array(root["boundingVolume"]["box"][3:]).reshape(3, 3).sum(0)
    return {
        "asset": {"version": "1.1", "extras": extras},
        **more,
        "geometricError": max(root["geometricError"], float(2 * np.linalg.norm(halves))),
        "root": {"refine": "REPLACE", **root},
    }
