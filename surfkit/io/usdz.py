"""OpenUSD stages, and .usdz files of them.

Source: https://openusd.org/release/spec_usdz.html: an uncompressed ZIP archive whose first file is the scene, and whose
files begin at multiples of 64 bytes.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.files import FILE_PREFIX, refuse_special, sync_folder
from surfkit.core.optional import needed

USDZ_SUFFIX = ".usdz"
SCENE_NAME = "scene.usdc"
"""Of the scene in an archive."""
NOTES = "surfkit"
"""Key in the custom data of the layer, under which files say how to read them back."""
ARCHIVE_TIME_S = 315_619_200
"""Of all files in an archive: 2 January 1980, which archives can have in every time zone."""
MAX_ARCHIVE_BYTES = 2**32 - 1
"""Of a ZIP archive without the extension for larger ones, which USDZ does not have."""
SCENE_SUFFIXES = (b".usdc", b".usda", b".usd")


def require_usd(what: str) -> None:
    """BadInput if OpenUSD is missing, for `what`."""
    with needed("pxr", what):
        from pxr import Usd, UsdVol  # noqa: F401


def new_stage(up: str, metres: float | None, notes: dict[str, Any]) -> Any:
    """An empty `Usd.Stage` in memory.

    Args:
        up: "Y" or "Z".
        metres: Per unit; where it is not known, a unit is said to be a metre, as USD would take it for a centimetre.
        notes: For us, of text, numbers, truth values and (3,) tuples of float.
    """
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, metres or 1.0)
    values = {key: Gf.Vec3d(*value) if isinstance(value, tuple) else value for key, value in notes.items()}
    stage.GetRootLayer().customLayerData = {NOTES: {key: value for key, value in values.items() if value is not None}}
    return stage


def place_prim(prim: Any, matrix: np.ndarray) -> None:
    """Give a prim a (4, 4) matrix from its coordinates to those of its parent."""
    from pxr import Gf, UsdGeom

    if not np.array_equal(matrix, np.eye(4)):
        UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(*matrix.T.ravel().tolist()))


def write_usdz(path: Path, stage: Any, files: Sequence[Path] = ()) -> None:
    """Save a stage and the files that it names, by their names, as one archive, which appears only when it is complete.

    Raises:
        BadInput: More than 4 GiB.
    """
    from pxr import Sdf

    path = Path(path)
    refuse_special(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=FILE_PREFIX, suffix=".part", dir=path.parent) as folder:
        scene, archive = Path(folder) / SCENE_NAME, Path(folder) / "archive.usdz"
        stage.GetRootLayer().Export(str(scene))
        if sum(file.stat().st_size + 256 for file in (scene, *files)) > MAX_ARCHIVE_BYTES:
            raise BadInput(f"{path}: more than 4 GiB, which such a file cannot have; take another format, or fewer")
        writer = Sdf.ZipFileWriter.CreateNew(str(archive))
        for file in (scene, *(shutil.copyfile(file, Path(folder) / file.name) for file in files)):
            os.utime(file, (ARCHIVE_TIME_S, ARCHIVE_TIME_S))  # which is stored: the same content gives the same bytes
            writer.AddFile(str(file), file.name)
        writer.Save()
        with archive.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(archive, path)
    sync_folder(path.parent)


def knows_usdz(head: bytes) -> bool:
    """Whether a file that begins like this is an archive of USD: its first file is a scene."""
    return head.startswith(b"PK\3\4") and head[30 : 30 + int.from_bytes(head[26:28], "little")].endswith(SCENE_SUFFIXES)


def open_usdz(path: Path) -> Any:
    """The `Usd.Stage` of an archive whose checksums are right.

    Raises:
        BadInput: No such file, or damaged.
    """
    from pxr import Sdf, Tf, Usd

    try:
        with zipfile.ZipFile(path) as archive:
            bad = archive.testzip()
        if bad is not None:
            raise BadInput(f"{path}: damaged: the checksum of {bad} is wrong; write or copy it again")
        return Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(str(path)))  # by name, a file that was open before comes back
    except (zipfile.BadZipFile, EOFError, NotImplementedError, Tf.ErrorException) as error:
        raise BadInput(f"{path}: damaged, or no .usdz file; write or copy it again") from error
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
