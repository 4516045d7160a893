"""What a scene was read from, as a hash by which two people can see that they measured on the same."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.codec import dump, read_json, write_json
from surfkit.io.datasets.fingerprint import Fingerprint, fingerprint
from surfkit.scene.photo_names import PICTURE_SUFFIXES
from surfkit.scene.scene import Scene

DATA_FILE = "data.json"
"""In the folder of a scene: what was read when it was looked at last."""


def data_hash(scene: Scene, files: Sequence[Path], root: Path, out: Path) -> str:
    """Sixteen hex digits of all that is read of a scene: cameras, sparse points, names and contents of photographs and
    of their masks, which photographs are held out, and the ground truth.

    Photographs count by size and by three pieces of 64 kB of each, the truth whole. What has the size and the time that
    it had is not read again. Depth maps are not part of it: they are made, and what made them is looked at.

    Args:
        scene: What is in the data set.
        files: Of the truth, and folders of such.
        root: That they lie below: where the folder lies does not count.
        out: Of the results of the scene, for what was read.
    """
    path = out / DATA_FILE
    try:
        before = read_json(path, Fingerprint) if path.exists() else None
    except BadInput:  # of another version: everything is read again
        before = None
    whole = [each for file in files for each in (pictures_in(file) if file.is_dir() else [file])]
    now = fingerprint(scene, before, None, whole)
    now = Fingerprint(now.points, now.photographs, now.beside, {str(file): now.files[str(file)] for file in whole})
    write_json(path, now)
    parts = dump(now)
    parts["files"] = {Path(name).relative_to(root).as_posix(): _timeless(it) for name, it in parts["files"].items()}
    for photo in parts["photographs"].values():
        photo["beside"] = {what: _timeless(stamp) for what, stamp in photo["beside"].items()}
    parts["photographs"] = {name: _timeless(photo) for name, photo in parts["photographs"].items()}
    frame = {"origin": [float(f"{it:.9g}") for it in scene.frame.origin], "scale": float(f"{scene.frame.scale:.9g}")}
    return hashlib.sha256(json.dumps([parts, frame], sort_keys=True).encode()).hexdigest()[:16]


def _timeless(stamp: dict[str, object]) -> dict[str, object]:
    return {name: it for name, it in stamp.items() if name != "time_ns"}


def pictures_in(folder: Path) -> list[Path]:
    """The pictures in a folder and in those inside, links among them, in the order of their paths."""
    found: list[Path] = []
    been: set[str] = set()
    for here, inner, names in os.walk(folder, followlinks=True):
        been.add(os.path.realpath(here))
        inner[:] = [name for name in inner if os.path.realpath(os.path.join(here, name)) not in been]
        found += [Path(here, name) for name in names if Path(name).suffix.lower() in PICTURE_SUFFIXES]
    return sorted(path for path in found if not path.name.startswith("._"))  # what macOS writes beside files
