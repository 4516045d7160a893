"""What readers of cameras of other programs share: the file, numbers in text, poses, and photographs by their names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput, few, reject
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawImage, Tracks, shorten
from surfkit.io.datasets.undistort import is_panorama
from surfkit.scene.connected_photos import connect_groups
from surfkit.scene.photo_names import find_files

MAX_CAMERA_NUMBER = 1e30
"""Numbers beyond it are a mistake."""
MAX_ROTATION_ERROR = 1e-3
"""Most that the entries of a rotation times its transpose are off those of the identity."""


def one_file(root: Path, files: Sequence[Path], lacking: str) -> Path:
    """The only one of the files of cameras in a folder.

    Args:
        root: The folder, for messages.
        files: Those that were found.
        lacking: What is missing if there are none, and how to get it.

    Raises:
        BadInput: There are none, or several.
    """
    if len(files) == 1:
        return files[0]
    if files:
        raise BadInput(f"{root}: several files of cameras: {few([path.name for path in files])}; leave one")
    raise BadInput(f"{root}: no {lacking}")


def numbers(where: str, text: str | Sequence[str], count: int) -> np.ndarray:
    """(count,) float64 from words, or BadInput that names `where` they come from."""
    words = text.split() if isinstance(text, str) else text
    wanted = "a finite number belongs" if count == 1 else f"{count} finite numbers belong"
    try:
        values = np.array([float(word) for word in words], np.float64)
    except (ValueError, TypeError) as error:
        raise BadInput(f"{where}: {shorten(text)}, where {wanted}") from error
    if len(values) != count or not (np.abs(values) < MAX_CAMERA_NUMBER).all():
        raise BadInput(f"{where}: {shorten(text)}, where {wanted}")
    return values


def read_text(path: Path) -> str:
    """What a text file says, or BadInput."""
    with _readable(path):
        return path.read_text(encoding="utf-8-sig")


def read_lines(path: Path) -> Iterator[str]:
    """The lines of a text file that may be larger than the memory, or BadInput."""
    with _readable(path), path.open(encoding="utf-8-sig") as file:
        yield from file


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """BadInput for a text file that cannot be read."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: not UTF-8; write it again, or rename photographs with such letters") from error


def pose_at(where: str, turn: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(4, 4) world_to_camera of a (3, 3) rotation from the world to the camera and the (3,) place of the camera.

    Raises:
        BadInput: It is no rotation; names `where` it comes from.
    """
    off = np.abs(turn @ turn.T - np.eye(3)).max() if (np.abs(turn) < 2).all() else np.inf
    if not (off < MAX_ROTATION_ERROR and np.linalg.det(turn) > 0 and (np.abs(centre) < MAX_CAMERA_NUMBER).all()):
        raise BadInput(
            f"{where}: the pose is not a rotation and a place; write the file again, or leave the camera out"
        )
    left, _, right = np.linalg.svd(turn)
    pose = np.eye(4)
    pose[:3, :3] = left @ right
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def photographs(data: Data, names: Sequence[str], home: str = "images") -> dict[str, Path]:
    """The files of photographs by name: in images/, or beside the cameras, or where --images says.

    Args:
        data: The data set.
        names: Of the photographs.
        home: The folder in it where those that are missing belong.

    Raises:
        BadInput: Some are missing, or two have the same name.
    """
    own = data.images or Path("images")
    folder = data.path / own if data.images or (data.path / own).is_dir() else data.path
    if twice := sorted(name for name, count in Counter(names).items() if count > 1):
        reject(
            BadInput(f"{data.path}: {few(twice)} stand for two photographs each; give photographs names of their own")
        )
    found = find_files(folder, list(dict.fromkeys(names)))
    missing = [name for name in names if name not in found]
    data.lack(folder, missing, len(names), f"; put them into {data.path / home}, or name their folder with --images")
    return found


def leave_out(path: Path, names: Sequence[str], count: int, why: str) -> None:
    """A line about photographs that are left out; BadInput if they are all."""
    if not names:
        return
    if len(names) == count:
        raise BadInput(f"{path}: all {count} photographs {why}; align them, and write the file again")
    emit(Warned(f"{path}: {len(names)} of {count} photographs are left out, which {why}: {few(names)}"))


def tracks_of(shots: Sequence[RawImage], xyz: np.ndarray, seen: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Tracks:
    """The observations of sparse points, with the mean error of each point in pixels.

    Args:
        shots: That see them.
        xyz: (P, 3) float64.
        seen: By name of the photograph: (K,) int64 rows of xyz, (K, 2) float64 pixels.
    """
    total, count = np.zeros(len(xyz)), np.zeros(len(xyz))
    cameras: dict[str, Any] = {}
    for shot in shots:
        if shot.name not in seen:
            continue
        cameras[shot.name] = shot.camera
        rows, pixels = seen[shot.name]
        local = xyz[rows] @ shot.pose[:3, :3].T + shot.pose[:3, 3]
        ahead = (local[:, 2] > 0) | is_panorama(shot.camera)
        error = np.full(len(rows), np.inf)
        if ahead.any():
            error[ahead] = np.linalg.norm(np.asarray(shot.camera.img_from_cam(local[ahead])) - pixels[ahead], axis=1)
        np.add.at(total, rows, np.where(np.isfinite(error), error, np.inf))
        np.add.at(count, rows, 1)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.inf)
    return Tracks(xyz, mean, {name: seen[name] for name in cameras}, cameras)


def groups_of(shots: Sequence[RawImage], seen: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[list[str]]:
    """Names of the photographs that sparse points connect, as `Capture` has them."""
    names = [shot.name for shot in shots if len(seen.get(shot.name, ((),))[0])]
    if not names:
        return []
    rows = np.concatenate([seen[name][0] for name in names])
    places = np.repeat(np.arange(len(names)), [len(seen[name][0]) for name in names])
    order = np.argsort(rows, kind="stable")
    starts = np.flatnonzero(np.diff(rows[order], prepend=-1))
    ends, places = np.append(starts[1:], len(rows)), places[order]
    shuffled = (places[starts[at] : ends[at]].tolist() for at in np.random.default_rng(0).permutation(len(starts)))
    return [[names[at] for at in group] for group in connect_groups(len(names), shuffled)]
