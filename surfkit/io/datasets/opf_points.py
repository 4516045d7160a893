"""Sparse points of an OPF project: a glTF file of the calibration, with the marks of each point in the photographs.

The specification of OPF (point_cloud) says what is in it: positions, colours, and of each point a range of matches,
packed as a first match of 40 bits and a count of 24. The frame of glTF has y up, that of the project z.
"""

from __future__ import annotations

import os
from base64 import b64decode
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.io.datasets.camera_files import numbers
from surfkit.io.datasets.raw_dataset import shorten
from surfkit.io.glb import ACCESSOR_WIDTHS
from surfkit.scene.rotations import numpy_rotations

COMPONENT_DTYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""Types of glTF's components."""
GLTF_TO_PROJECT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From glTF's frame to that of the project."""
MATCHES = "OPF_mesh_primitive_matches"
OFFSET_BITS = 40
EXPORT_AGAIN = "export the project again"


@dataclass(frozen=True)
class OpfPoints:
    """The points of a file.

    Attributes:
        xyz: (P, 3) float64, frame of the project.
        rgb: (P, 3) uint8, grey where the file has no colours.
        seen: By identifier of the camera, (K,) int64 rows of xyz and (K, 2) float64 pixels.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    seen: dict[int, tuple[np.ndarray, np.ndarray]]


def read_opf_points(path: Path, root: Path) -> OpfPoints:
    """The points of a glTF file of OPF.

    Args:
        path: The file.
        root: Folder of the project, outside which none of its files lies.

    Raises:
        BadInput: A file of it is missing, cut off, or not as OPF has it.
    """
    try:
        return _read(_GltfFile(path, root, read_json(path, dict[str, Any])))
    except BadInput:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        lacking = f": {error} is missing" if isinstance(error, KeyError) else ""
        raise BadInput(f"{path}: damaged, or not as OPF has sparse points{lacking}; {EXPORT_AGAIN}") from error


@dataclass(frozen=True)
class _GltfFile:
    """A glTF file, the folder of its project, and what it says."""

    path: Path
    root: Path
    contents: Mapping[str, Any]

    def entry(self, name: str, at: Any) -> Mapping[str, Any]:
        """One of the objects in a list of the file."""
        listed = self.contents.get(name, [])
        if type(at) is not int or not 0 <= at < len(listed):
            raise BadInput(f"{self.path}: names number {shorten(at)} of its {len(listed)} {name}; {EXPORT_AGAIN}")
        return listed[at]

    def values(self, accessor: Any) -> np.ndarray:
        """(N, width) what an accessor reads."""
        given = self.entry("accessors", accessor)
        view = self.entry("bufferViews", given["bufferView"])
        if given["type"] not in ACCESSOR_WIDTHS or given["componentType"] not in COMPONENT_DTYPES:
            what = f"{shorten(given['type'])} of type {shorten(given['componentType'])}"
            raise BadInput(f"{self.path}: accessor {accessor} is {what}, which OPF does not use; {EXPORT_AGAIN}")
        width, kind = ACCESSOR_WIDTHS[given["type"]], np.dtype(COMPONENT_DTYPES[given["componentType"]])
        if "byteStride" in view or given.get("byteOffset"):
            raise BadInput(f"{self.path}: its buffers are interleaved, which OPF does not do; {EXPORT_AGAIN}")
        count, offset = given["count"], view.get("byteOffset", 0)
        if type(count) is not int or type(offset) is not int or min(count, offset) < 0:
            raise BadInput(
                f"{self.path}: accessor {accessor} has {shorten(count)} values from byte {shorten(offset)} on; "
                f"{EXPORT_AGAIN}"
            )
        uri = str(self.entry("buffers", view["buffer"])["uri"])
        held = self._decoded(uri) if uri.startswith("data:") else None
        path = self.path if held is not None else self._beside(uri)
        try:
            size = path.stat().st_size if held is None else len(held)
            if offset + count * width * kind.itemsize > size:  # before memory is asked for
                raise BadInput(f"{path}: cut off; copy the project whole")
            if held is None:
                found = np.fromfile(path, kind, count * width, offset=offset)
            else:
                found = np.frombuffer(held, kind, count * width, offset)
        except OSError as error:
            raise BadInput(f"{path}: cannot be read: {error.strerror}; copy the project whole") from error
        return found.reshape(-1, width)

    def _decoded(self, uri: str) -> bytes:
        """The bytes of a buffer that the file holds itself."""
        head, _, text = uri.partition(",")
        try:
            if not head.endswith(";base64"):
                raise ValueError
            return b64decode(unquote(text), validate=True)
        except ValueError as error:
            raise BadInput(f"{self.path}: a buffer in it is not in base64: {shorten(uri)}; {EXPORT_AGAIN}") from error

    def _beside(self, uri: str) -> Path:
        """The file of a buffer, or BadInput for one that is none of the project."""
        name = unquote(uri)
        path = Path(os.path.abspath(self.path.parent / name))
        homes = (Path(os.path.abspath(home)) for home in (self.root, self.path.parent))
        if Path(name).is_absolute() or "://" in name or not any(path.is_relative_to(home) for home in homes):
            raise BadInput(f"{self.path}: names {shorten(name)}, which does not lie in the project; {EXPORT_AGAIN}")
        return self.path.parent / name

    def moves(self) -> list[np.ndarray]:
        """(4, 4) from the frame of each node to that of the file, by its parents."""
        nodes = self.contents["nodes"]
        own = [self._move(f"{self.path}: node {at}", node) for at, node in enumerate(nodes)]
        parents = {child: at for at, node in enumerate(nodes) for child in node.get("children", [])}
        found = []
        for at, move in enumerate(own):
            above = [at]
            while (parent := parents.get(above[-1])) is not None:
                if parent in above:
                    raise BadInput(f"{self.path}: node {parent} is its own parent; {EXPORT_AGAIN}")
                above.append(parent)
                move = own[parent] @ move
            found.append(move)
        return found

    @staticmethod
    def _move(where: str, node: Mapping[str, Any]) -> np.ndarray:
        """(4, 4) from the frame of a node to that of its parent."""
        if "matrix" in node:
            return numbers(f"{where}: matrix", node["matrix"], 16).reshape(4, 4).T
        x, y, z, w = numbers(f"{where}: rotation", node.get("rotation", [0, 0, 0, 1]), 4)
        if not any((x, y, z, w)):
            raise BadInput(f"{where}: rotation: a quaternion of zeros; {EXPORT_AGAIN}")
        move = np.eye(4)
        move[:3, :3] = numpy_rotations(np.array([[w, x, y, z]]))[0]
        move[:3, :3] *= numbers(f"{where}: scale", node.get("scale", [1, 1, 1]), 3)
        move[:3, 3] = numbers(f"{where}: translation", node.get("translation", [0, 0, 0]), 3)
        return move


def _read(file: _GltfFile) -> OpfPoints:
    xyz, rgb, begin = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], 0
    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for node, local_move in zip(file.contents["nodes"], file.moves(), strict=True):
        if "mesh" not in node:
            continue
        mesh = file.entry("meshes", node["mesh"])["primitives"][0]
        local = file.values(mesh["attributes"]["POSITION"]).astype(np.float64)
        move = GLTF_TO_PROJECT @ local_move
        xyz.append(local @ move[:3, :3].T + move[:3, 3])
        colour = mesh["attributes"].get("COLOR_0")
        grey = np.full(local.shape, 128, np.uint8)
        rgb.append(grey if colour is None else file.values(colour)[:, :3].astype(np.uint8))
        for camera, rows, pixels in _matches(file, mesh.get("extensions", {}).get(MATCHES), len(local)):
            before = seen.get(camera, (np.zeros(0, np.int64), np.zeros((0, 2))))
            seen[camera] = np.concatenate([before[0], rows + begin]), np.concatenate([before[1], pixels])
        begin += len(local)
    found = OpfPoints(np.concatenate(xyz), np.concatenate(rgb), seen)
    if not np.isfinite(found.xyz).all():
        raise BadInput(f"{file.path}: points without finite coordinates; {EXPORT_AGAIN}")
    return found


def _matches(file: _GltfFile, given: Any, points: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Of each camera, its identifier, rows of the points that it shows and their pixels; none if the file has none."""
    if given is None or "imagePoints" not in given:
        return []
    packed = file.values(given["pointIndexRanges"]).astype(np.uint64)
    packed = packed[:, 0] | packed[:, 1] << np.uint64(32)
    first = (packed & np.uint64((1 << OFFSET_BITS) - 1)).astype(np.int64)
    counts = (packed >> np.uint64(OFFSET_BITS)).astype(np.int64)
    cameras = file.values(given["cameraIds"])[:, 0]
    pixels = file.values(given["imagePoints"]["pixelCoordinates"]).astype(np.float64)
    lost = len(counts) != points or (first + counts).max(initial=0) > min(len(cameras), len(pixels))
    if lost or (len(cameras) and cameras.max() >= len(given["cameraUids"])):
        raise BadInput(f"{file.path}: its points have matches that are not there; {EXPORT_AGAIN}")
    rows = np.repeat(np.arange(points), counts)
    at = np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
    found = []
    for index, uid in enumerate(given["cameraUids"]):
        chosen = cameras[at] == index
        number = int(uid, 16) if isinstance(uid, str) else int(uid)  # drafts of OPF write hexadecimal text
        found.append((number, rows[chosen], pixels[at][chosen]))
    return found
