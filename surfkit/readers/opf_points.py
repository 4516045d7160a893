"""Sparse points of an OPF project: a glTF file of the calibration, with the marks of each point in the photographs.

The specification of OPF (point_cloud) says what is in it: positions, colours, and of each point a range of matches,
packed as a first match of 40 bits and a count of 24. The frame of glTF has y up, that of the project z.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.readers.camera_files import numbers

KINDS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Types of glTF's components."""
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From glTF's frame to that of the project."""
MATCHES = "OPF_mesh_primitive_matches"
OFFSET_BITS = 40
AGAIN = "export the project again"


@dataclass(frozen=True)
class Points:
    """The points of a file.

    Attributes:
        xyz: (P, 3) float64, frame of the project.
        rgb: (P, 3) uint8, grey where the file has no colours.
        seen: By identifier of the camera, (K,) int64 rows of xyz and (K, 2) float64 pixels.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    seen: dict[int, tuple[np.ndarray, np.ndarray]]


def read_opf_points(path: Path) -> Points:
    """The points of a glTF file of OPF.

    Raises:
        BadInput: A file of it is missing, cut off, or not as OPF has it.
    """
    try:
        return _read(_File(path, read_json(path, dict[str, Any])))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise BadInput(
            f"{path}: damaged, or not as OPF has sparse points: {type(error).__name__} {error}; {AGAIN}"
        ) from error


@dataclass(frozen=True)
class _File:
    """A glTF file, and what it says."""

    path: Path
    contents: Mapping[str, Any]

    def values(self, accessor: int) -> np.ndarray:
        """(N, width) what an accessor reads."""
        given = self.contents["accessors"][accessor]
        view = self.contents["bufferViews"][given["bufferView"]]
        path = self.path.parent / unquote(self.contents["buffers"][view["buffer"]]["uri"])
        width, kind = WIDTHS[given["type"]], np.dtype(KINDS[given["componentType"]])
        if "byteStride" in view or given.get("byteOffset"):
            raise BadInput(f"{self.path}: its buffers are interleaved, which OPF does not do; {AGAIN}")
        try:
            found = np.fromfile(path, kind, given["count"] * width, offset=view.get("byteOffset", 0))
        except OSError as error:
            raise BadInput(f"{path}: cannot be read: {error.strerror}; copy the project whole") from error
        if len(found) != given["count"] * width:
            raise BadInput(f"{path}: cut off; copy the project whole")
        return found.reshape(-1, width)


def _read(file: _File) -> Points:
    xyz, rgb, begin = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], 0
    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for node in file.contents["nodes"]:
        if "mesh" not in node:
            continue
        mesh = file.contents["meshes"][node["mesh"]]["primitives"][0]
        local = file.values(mesh["attributes"]["POSITION"]).astype(np.float64)
        given = numbers(f"{file.path}: matrix", node.get("matrix", np.eye(4).ravel().tolist()), 16)
        move = Z_UP @ given.reshape(4, 4).T
        xyz.append(local @ move[:3, :3].T + move[:3, 3])
        colour = mesh["attributes"].get("COLOR_0")
        grey = np.full(local.shape, 128, np.uint8)
        rgb.append(grey if colour is None else file.values(colour)[:, :3].astype(np.uint8))
        for camera, rows, pixels in _matches(file, mesh.get("extensions", {}).get(MATCHES), len(local)):
            before = seen.get(camera, (np.zeros(0, np.int64), np.zeros((0, 2))))
            seen[camera] = np.concatenate([before[0], rows + begin]), np.concatenate([before[1], pixels])
        begin += len(local)
    found = Points(np.concatenate(xyz), np.concatenate(rgb), seen)
    if not np.isfinite(found.xyz).all():
        raise BadInput(f"{file.path}: points without finite coordinates; {AGAIN}")
    return found


def _matches(file: _File, given: Any, points: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Of each camera, its identifier, rows of the points that it shows and their pixels; none if the file has none."""
    if given is None or "imagePoints" not in given:
        return []
    packed = file.values(given["pointIndexRanges"]).astype(np.uint64)
    packed = packed[:, 0] | packed[:, 1] << np.uint64(32)
    first = (packed & np.uint64((1 << OFFSET_BITS) - 1)).astype(np.int64)
    counts = (packed >> np.uint64(OFFSET_BITS)).astype(np.int64)
    cameras = file.values(given["cameraIds"])[:, 0]
    pixels = file.values(given["imagePoints"]["pixelCoordinates"]).astype(np.float64)
    if len(counts) != points or (first + counts).max(initial=0) > min(len(cameras), len(pixels)):
        raise BadInput(f"{file.path}: its points have matches that are not there; {AGAIN}")
    rows = np.repeat(np.arange(points), counts)
    at = np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
    found = []
    for index, uid in enumerate(given["cameraUids"]):
        chosen = cameras[at] == index
        number = int(uid, 16) if isinstance(uid, str) else int(uid)  # drafts of OPF write hexadecimal text
        found.append((number, rows[chosen], pixels[at][chosen]))
    return found
