"""What is kept of a textured mesh that is being made, and digests of what it is made of."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from surfkit.core.files import replacing
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.scene.scene import View

CHOICE_VERSION = 2
"""Raised when photographs are chosen, or brought to one light, otherwise; nothing of an interrupted call stays."""
BATCH_ROWS = 1 << 20
"""Rows that are looked at at once."""
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class TextureCache:
    """Arrays by name.

    Attributes:
        folder: Where they are kept; None keeps none.
        level: Of detail, 0 for the finest.
    """

    folder: Path | None = None
    level: int = 0

    def of(self, level: int) -> TextureCache:
        """The same for another level of detail."""
        return replace(self, level=level)

    def once(self, name: str, make: Callable[[], Arrays]) -> Arrays:
        """What `make` returns; what was kept under this name if there is any."""
        if (found := self.read(name)) is None:
            found = {key: np.ascontiguousarray(value) for key, value in make().items()}
            self.write(name, found)
        return found

    def write(self, name: str, arrays: Arrays) -> None:
        """Keep arrays, instead of those of the same name."""
        if self.folder is not None:
            with replacing(self._file(self.folder, name)) as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # no array is called allow_pickle

    def read(self, name: str) -> Arrays | None:
        """What was kept under a name; None if there is nothing, or it is damaged."""
        if self.folder is None or not self._file(self.folder, name).exists():
            return None
        try:
            with np.load(self._file(self.folder, name), allow_pickle=False) as found:
                return dict(found)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return None

    def forget(self, name: str) -> None:
        """Delete what was kept under a name."""
        if self.folder is not None:
            self._file(self.folder, name).unlink(missing_ok=True)

    def _file(self, folder: Path, name: str) -> Path:
        return folder / f"{name}-{self.level}.npz"


def identity(surface: SurfaceFile) -> str:
    """A digest of a mesh: of its vertices with all that they have, and its triangles."""
    faces = surface.triangles
    kinds = surface.rows.dtype, len(surface), faces.dtype, len(faces), surface.offset
    found = hashlib.sha256(" ".join(map(str, kinds)).encode())
    for rows in (surface.rows, faces):
        for at in range(0, len(rows), BATCH_ROWS):
            found.update(np.ascontiguousarray(rows[at : at + BATCH_ROWS]).data)
    return found.hexdigest()


def seen(views: Sequence[View]) -> str:
    """A digest of the cameras, photographs and masks of views, files by size and time, and of how they are chosen."""
    found = hashlib.sha256(f"{CHOICE_VERSION}".encode())
    for view in views:
        camera = view.camera
        lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        found.update(f"{view.name} {lens}".encode() + camera.world_to_camera.contiguous().numpy().tobytes())
        mask = None if view.mask is None else view.mask.path
        found.update(b"alpha" if view.mask is not None and view.mask.alpha else b"")
        for path in (view.path, mask):
            facts = path.stat() if path is not None and path.exists() else None
            found.update(f"{facts and (facts.st_size, facts.st_mtime_ns)}".encode())
    return found.hexdigest()
