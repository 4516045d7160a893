"""Bundler: bundle.out with cameras, points and their tracks, and a list of the photographs.

The layout is that of the Bundler v0.4 manual, section "Output format and scene representation"; COLMAP, VisualSFM,
Metashape and others write it too.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput, few, leaving_out, reject
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.camera_files import (
    MAX_CAMERA_NUMBER,
    groups_of,
    leave_out,
    one_file,
    photographs,
    pose_at,
    read_text,
    tracks_of,
)
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, Tracks, camera_of
from surfkit.scene.photos import photo_size

BUNDLE_FILES = ("bundle.out", "bundle/bundle.out")
"""Where Bundler writes its file; other programs call it NAME.bundle.out."""
HEADER_PREFIX, MAX_HEADER_BYTES = "# Bundle file v0.3", 1000
"""How the file begins, and bytes of its first line at most."""
MARK_SLACK_PX = 2.0
"""How far beyond the edge of a photograph a mark may lie, as programs differ by half a pixel."""
MIN_STRAY_MARKS, MIN_STRAY_SHARE = 3, 0.02
"""So many marks, and so large a share of them, lie outside of a photograph by no mistake."""
MAX_INNER_SHARE, MIN_INNER_MARKS = 0.7, 500
"""Share of the way from the middle to the edge that some of so many marks lie beyond."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
"""From Bundler's cameras (x right, y up, z backward) to x right, y down, z forward."""


@dataclass(frozen=True)
class Bundler(Reader):
    """Bundler: bundle.out, a list of the photographs (list.txt), and images/; sparse points with their tracks."""

    def recognises(self, root: Path) -> bool:
        return bool(_files(root))

    def read(self, data: Data) -> RawDataset:
        bundle = _Bundle.read(data)
        shots, seen = bundle.shots(data), bundle.seen()
        _check_sizes(bundle.path, shots, seen)
        return RawDataset(shots, bundle.xyz, bundle.rgb, groups=groups_of(shots, seen))

    def tracks(self, data: Data) -> Tracks:
        bundle = _Bundle.read(data)
        shots = bundle.shots(data)
        sizes = {shot.name: (shot.camera.width, shot.camera.height) for shot in shots}
        seen = {
            name: (rows, np.array(sizes[name]) / 2 + offset * (1, -1))
            for name, (rows, offset) in bundle.seen().items()
            if name in sizes
        }
        return tracks_of(shots, bundle.xyz, seen)


@dataclass(frozen=True)
class _Bundle:
    """What the files say.

    Attributes:
        path: The bundle file.
        names: Of V photographs.
        cameras: (V, 5, 3): focal length, k1, k2; rotation; translation; focal length 0 of those without a camera.
        xyz, rgb: (P, 3) float64 and uint8.
        sights: (K, 4) float64: camera, key, and pixels from the middle of the photograph, right and up.
        rows: (K,) int64 of xyz.
    """

    path: Path
    names: list[str]
    cameras: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    sights: np.ndarray
    rows: np.ndarray

    @classmethod
    def read(cls, data: Data) -> _Bundle:
        """The files of a data set, or BadInput."""
        path = one_file(data.path, _files(data.path), "bundle.out; copy it there, with list.txt")
        values = _values(path)
        cameras, points = (_count(path, value, len(values)) for value in values[:2])
        begin = 2 + 15 * cameras
        if len(values) < begin:
            raise BadInput(f"{path}: cut off: numbers of {(len(values) - 2) // 15} of {cameras} cameras are there")
        names = _names(path, cameras)
        table, starts, counts = _points(path, values, begin, points)
        good = (np.abs(table) < MAX_CAMERA_NUMBER).all(1)
        kept = np.cumsum(good) - 1
        rows = np.repeat(np.where(good, kept, -1), counts)
        inside = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        at = np.repeat(starts, counts) + 4 * inside
        sights = values[at[:, None] + np.arange(4)].reshape(-1, 4)
        use = (rows >= 0) & np.isfinite(sights).all(1) & (sights[:, 0] >= 0) & (sights[:, 0] < cameras)
        rgb = table[good, 3:].clip(0, 255).astype(np.uint8)
        shaped = values[2:begin].reshape(-1, 5, 3)
        return cls(path, names, shaped, table[good, :3], rgb, sights[use], rows[use])

    def shots(self, data: Data) -> list[RawImage]:
        """The photographs with a camera."""
        has = self.cameras[:, 0, 0] != 0
        placed = [name for name, there in zip(self.names, has, strict=True) if there]
        without = [name for name, there in zip(self.names, has, strict=True) if not there]
        leave_out(self.path, without, len(self.names), "have no camera (focal length 0)")
        found, shots = photographs(data, placed), []
        for name, camera, there in zip(self.names, self.cameras, has, strict=True):
            if there and name in found:
                with leaving_out():
                    shots.append(self._shot(name, camera, found[name]))
        return shots

    def _shot(self, name: str, camera: np.ndarray, photo: Path) -> RawImage:
        where, (focal, k1, k2), turn = f"{self.path}: camera of {name!r}", camera[0], camera[1:4]
        if not np.isfinite(camera).all() or not focal > 0:
            raise BadInput(f"{where}: focal length {focal:g}, or numbers that are not finite")
        width, height = photo_size(photo)
        pose = pose_at(where, OPENGL_TO_OPENCV @ turn, -turn.T @ camera[4])
        return RawImage(
            name, pose, camera_of(where, "RADIAL", (width, height), [focal, width / 2, height / 2, k1, k2]), photo
        )

    def seen(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """By name of the photograph: rows of xyz, and pixels from its middle, right and up."""
        order = np.argsort(self.sights[:, 0], kind="stable")
        cut = np.searchsorted(self.sights[order, 0], np.arange(1, len(self.names)))
        parts = np.split(order, cut)
        return {name: (self.rows[part], self.sights[part, 2:]) for name, part in zip(self.names, parts, strict=True)}


def _check_sizes(path: Path, shots: Sequence[RawImage], seen: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """BadInput for photographs that are smaller than when their cameras were found, of which the file has no sizes: the
    marks of points lie outside then. A line where all marks lie far inside, as if photographs had been enlarged."""
    outside, reach, most = [], 0.0, 0.0
    for shot in shots:
        half = np.array([shot.camera.width, shot.camera.height]) / 2
        offsets = np.abs(seen[shot.name][1])
        beyond = (offsets > half + MARK_SLACK_PX).any(1)
        if beyond.sum() >= MIN_STRAY_MARKS and beyond.mean() > MIN_STRAY_SHARE:
            outside.append(shot.name)
            most = max(most, float((offsets / half).max()))
        reach = max(reach, float((offsets / half).max(initial=0)))
    if outside:
        reject(
            BadInput(
                f"{path}: marks of points lie outside of {len(outside)} of {len(shots)} photographs, {few(outside)}, "
                f"up to {most:.2f} times as far from the middle as their edge: these are smaller than the photographs "
                "that the cameras were found for, or turned; use those"
            )
        )
    elif 0 < reach < MAX_INNER_SHARE and sum(len(seen[shot.name][1]) for shot in shots) >= MIN_INNER_MARKS:
        emit(
            Warned(
                f"{path}: all marks of points lie in the inner {reach:.0%} of the photographs: if these are larger "
                "than those that the cameras were found for, use those, as the file has no sizes"
            )
        )


def _files(root: Path) -> list[Path]:
    """The bundle files of a folder; those in the usual places first."""
    usual = [root / place for place in BUNDLE_FILES if (root / place).is_file()]
    return usual[:1] or sorted(path for path in root.glob("*.bundle.out") if path.is_file())


def _values(path: Path) -> np.ndarray:
    """All numbers of a bundle file."""
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("error")
            head = file.readline(MAX_HEADER_BYTES).decode("utf-8-sig", "replace")
            values = np.fromfile(file, np.float64, sep=" ") if head.startswith(HEADER_PREFIX) else np.empty(0)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, DeprecationWarning) as error:
        raise BadInput(f"{path}: something that is no number lies among the numbers; copy the file whole") from error
    if not head.startswith(HEADER_PREFIX):
        raise BadInput(
            f"{path}: begins with {head.strip()[:40]!r}, not with {HEADER_PREFIX!r}, the version that is read"
        )
    if len(values) < 2:
        raise BadInput(f"{path}: cut off after the first line; copy it whole")
    return values


def _count(path: Path, value: float, most: int) -> int:
    if not (value == int(value) if np.isfinite(value) else False) or not 0 <= value <= most:
        raise BadInput(f"{path}: {value:g} cameras or points, in a file of {most} numbers; copy it whole")
    return int(value)


def _points(path: Path, values: np.ndarray, begin: int, points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(P, 6) positions and colours, where the sights of each begin, and how many there are."""
    heads, counts, at, end = np.zeros(points, np.int64), np.zeros(points, np.int64), begin, len(values)
    for row in range(points):
        number = values[at + 6] if at + 6 < end else np.nan
        if not (number >= 0 and number % 1 == 0 and at + 7 + 4 * number <= end):
            raise BadInput(f"{path}: cut off or damaged at point {row + 1} of {points}; copy it whole")
        heads[row], counts[row] = at, number
        at += 7 + 4 * int(number)
    return values[heads[:, None] + np.arange(6)].reshape(-1, 6), heads + 7, counts


def _names(path: Path, cameras: int) -> list[str]:
    """Of the photographs, in the order of the cameras."""
    stem = path.name.removesuffix(".out").removesuffix(".bundle")
    places = [path.with_name(name) for name in (f"{stem}.list.txt", f"{path.name}.list.txt", "list.txt")]
    if path.parent.name == "bundle":  # as Bundler itself does
        places.append(path.parent.parent / "list.txt")
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise BadInput(f"{path}: no list of the photographs beside it; put list.txt there, a name a line")
    lines = [line.strip() for line in read_text(file).splitlines() if line.strip()]
    if len(lines) != cameras:
        raise BadInput(f"{file}: names {len(lines)} photographs, {path.name} has {cameras} cameras; use the list of it")
    return [_name(line) for line in lines]


def _name(line: str) -> str:
    """The photograph of a line such as `./img 1.jpg 0 660.8`, where 0 and a focal length may follow."""
    words = line.rsplit(maxsplit=2)
    if len(words) == 3 and words[1] == "0" and words[2].replace(".", "", 1).isdigit():
        line = words[0]
    return line.replace("\\", "/").removeprefix("./").removeprefix("images/")
