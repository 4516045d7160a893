"""A cheap fingerprint of a data set, by which a run notices that its data are not what they were."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from surfkit.io.datasets.depth_files import DepthFile, confidence_path, normal_path
from surfkit.scene.scene import Scene, View

PIECE_BYTES = 1 << 16
"""Bytes that are read at the start, in the middle and at the end of a photograph."""


@dataclass(frozen=True)
class FileStamp:
    """What is known of a file beside a photograph.

    Attributes:
        size: Bytes; -1 if it cannot be read.
        time_ns: When it was last written. While this and the size stay, its content is not read again.
        content: Digest of three pieces of the file, or of all of it when it is not longer or the recipe names it.
        meaning: What else decides what its numbers mean, or a digest of it; empty where that is not known, as in older
            runs for masks.
    """

    size: int
    time_ns: int
    content: str
    meaning: str = ""


@dataclass(frozen=True)
class PhotoFingerprint:
    """What is known of one photograph.

    Attributes:
        camera: Digest of the camera.
        size: Of the file, bytes; -1 if it cannot be read.
        time_ns: When the file was last written. While this and the size stay, its content is not read again.
        content: Digest of three pieces of the file, or of all of it when it is not longer.
        held_out: Whether it is held out.
        beside: Its mask, depth map, confidence and normals, those that there are, by what they are.
    """

    camera: str
    size: int
    time_ns: int
    content: str
    held_out: bool
    beside: dict[str, FileStamp] = field(default_factory=dict)


@dataclass(frozen=True)
class Fingerprint:
    """What is known of a data set.

    Attributes:
        points: Digest of the sparse points, in the local frame.
        photographs: By name.
        beside: Whether the files beside them are included; older runs did not include them.
        files: Further files that the recipe names, by path.
    """

    points: str
    photographs: dict[str, PhotoFingerprint]
    beside: bool = False
    files: dict[str, FileStamp] = field(default_factory=dict)


@dataclass(frozen=True)
class Change:
    """One difference: in words, and the name of the photograph that it is about, if it is about one."""

    what: str
    name: str | None = None


def fingerprint(
    scene: Scene,
    before: Fingerprint | None = None,
    maps: Mapping[str, DepthFile] | None = None,
    files: Sequence[Path] = (),
) -> Fingerprint:
    """The fingerprint of a scene.

    Args:
        scene: The scene.
        before: Files that were not touched since then are not read again.
        maps: Depth maps by name of the photograph, if training uses them.
        files: Further files. What was known `before` of one that is gone stays known.
    """
    known = before.photographs if before else {}
    views = [(view, False) for view in scene.train] + [(view, True) for view in scene.held_out]
    prints = {view.name: _print(view, out, known.get(view.name), maps or {}) for view, out in views}
    kept = before.files if before else {}
    stamps = {str(path): _stamp(path, kept.get(str(path)), whole=True) for path in files}
    stamps = {path: kept.get(path, stamp) if stamp.size < 0 else stamp for path, stamp in stamps.items()}
    return Fingerprint(digest(scene.cloud), prints, beside=True, files=stamps)


def changed(old: Fingerprint, new: Fingerprint) -> list[Change]:
    """Every difference between two fingerprints, one for each photograph at most."""
    a, b = old.photographs, new.photographs
    found = [Change("the sparse points have changed")] if old.points != new.points else []
    found += [Change(f"photograph {name} is no longer there", name) for name in a if name not in b]
    found += [Change(f"photograph {name} is new", name) for name in b if name not in a]
    for name in a:
        if name not in b:
            continue
        if a[name].held_out != b[name].held_out:
            found.append(Change(f"photograph {name} is {'now' if b[name].held_out else 'no longer'} held out", name))
        elif a[name].camera != b[name].camera:
            found.append(Change(f"the camera of {name} has changed", name))
        elif (a[name].size, a[name].content) != (b[name].size, b[name].content):
            found.append(Change(f"photograph {name} has changed", name))
        elif old.beside and new.beside and (what := _beside_changed(a[name].beside, b[name].beside)):
            found.append(Change(f"the {what} of {name} has changed, come or gone", name))
    return found


def changed_file(old: Fingerprint, new: Fingerprint) -> str | None:
    """The path of a further file that has another content."""
    both = [path for path in new.files if path in old.files]
    return next((path for path in both if old.files[path].content != new.files[path].content), None)


def _beside_changed(old: Mapping[str, FileStamp], new: Mapping[str, FileStamp]) -> str | None:
    """What beside a photograph is not what it was."""
    for what in (*old, *new):
        a, b = old.get(what), new.get(what)
        if a is None or b is None or (a.size, a.content) != (b.size, b.content):
            return what
        if a.meaning and b.meaning and a.meaning != b.meaning:
            return what
    return None


def content_of(view: View) -> str:
    """A digest of what the file of a photograph holds, as far as a fingerprint looks at it."""
    stamp = _stamp(view.path, None)
    return digest([stamp.size, stamp.content])


def digest(value: Any) -> str:
    """Twenty hex digits for plain data, arrays and dataclasses of them.

    Floats count as float32, so that a last bit that another version of a library rounds differently does not.
    """
    found = hashlib.sha256()
    _feed(found, value)
    return found.hexdigest()[:20]


def _feed(found: Any, value: Any) -> None:
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            if not field.metadata.get("digest", True):
                continue
            found.update(f"\0{field.name}".encode())
            _feed(found, getattr(value, field.name))
    elif isinstance(value, (np.ndarray, float)):
        array = np.asarray(value)
        with np.errstate(over="ignore"):  # infinite, and so is another run's
            array = array.astype("<f4") if array.dtype.kind == "f" else array
        found.update(f"\0{array.dtype.str}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    elif isinstance(value, dict) and any(isinstance(each, (Tensor, np.ndarray)) for each in value.values()):
        _feed(found, [part for item in sorted(value.items()) for part in item])
    elif isinstance(value, (list, tuple)) and any(isinstance(each, (Tensor, np.ndarray)) for each in value):
        found.update(f"\0{len(value)}".encode())  # in words, long arrays are cut short
        for each in value:
            _feed(found, each)
    else:
        found.update(f"\0{value!r}".encode())


def _print(
    view: View, held_out: bool, before: PhotoFingerprint | None, maps: Mapping[str, DepthFile]
) -> PhotoFingerprint:
    photo = _stamp(view.path, before)
    known = before.beside if before else {}
    beside = {what: _stamp(path, known.get(what), meaning) for what, path, meaning in _beside(view, maps)}
    return PhotoFingerprint(digest(view.camera), photo.size, photo.time_ns, photo.content, held_out, beside)


def _beside(view: View, maps: Mapping[str, DepthFile]) -> Iterator[tuple[str, Path, str]]:
    """What lies beside a photograph: what it is, where, and what else decides what its numbers mean."""
    if view.mask is not None:
        yield "mask", view.mask.path, "alpha" if view.mask.alpha else "colours"
    if file := maps.get(view.name):
        yield "depth map", file.path, digest(file.meaning)
        if (path := confidence_path(file.path)).exists():
            yield "confidence of depth", path, ""
        if (path := normal_path(file.path)).exists():
            yield "normal map", path, ""


def _stamp(
    path: Path, before: FileStamp | PhotoFingerprint | None, meaning: str = "", whole: bool = False
) -> FileStamp:
    try:
        state = path.stat()
        if before is not None and (before.size, before.time_ns) == (state.st_size, state.st_mtime_ns):
            content = before.content
        else:
            content = _content(path, state.st_size, whole)
    except OSError:
        return FileStamp(-1, 0, "", meaning)
    return FileStamp(state.st_size, state.st_mtime_ns, content, meaning)


def _content(path: Path, size: int, whole: bool) -> str:
    found = hashlib.sha256()
    pieces = (
        range(0, size, PIECE_BYTES)
        if whole
        else sorted({0, max(0, (size - PIECE_BYTES) // 2), max(0, size - PIECE_BYTES)})
    )
    with path.open("rb") as file:
        for start in pieces:
            file.seek(start)
            found.update(file.read(PIECE_BYTES))
    return found.hexdigest()[:20]
