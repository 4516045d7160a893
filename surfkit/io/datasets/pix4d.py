"""Pix4Dmapper: the calibrated cameras in 1_initial/params, in the coordinates of the output.

PROJECT_calibrated_camera_parameters.txt begins with a list of what it has for each photograph: size, K, distortion,
position t and rotation R, with m = K [R|-Rt] X (Pix4D documentation, "What does the Output Params Folder contain?").
PROJECT_offset.xyz is left out of t, PROJECT_wkt.prj names the coordinate reference system.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import Brown, LensTable
from surfkit.io.datasets.camera_files import numbers, one_file, photographs, pose_at, read_text
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.exchange_formats import code_in_plan
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.transforms import points
from surfkit.scene.crs import from_wkt, in_plan, metres_of

PARAMETER_FOLDERS = ("", "params", "1_initial/params")
"""Where the files may lie."""
CAMERAS, EXTERNAL, OFFSET, CRS = (
    "_calibrated_camera_parameters.txt",
    "_calibrated_external_camera_parameters.txt",
    "_offset.xyz",
    "_wkt.prj",
)
"""Ends of the names of the files, behind that of the project."""
MATRIX_PATTERN = re.compile(r"(.+?) \[(\d)x(\d)\]")
MATRIX_SHAPES = {
    "camera matrix K": (3, 3),
    "radial distortion": (3, 1),
    "tangential distortion": (2, 1),
    "camera position t": (3, 1),
    "camera rotation R": (3, 3),
}
"""What a photograph may have in the file of cameras."""
MAX_OFFSET_DIFFERENCE = 1e-3
"""Most that two photographs may tell different offsets."""


@dataclass(frozen=True)
class Pix4D(Reader):
    """Pix4D: *_calibrated_camera_parameters.txt in the folder, in params/ or 1_initial/params/, and images/."""

    def recognises(self, root: Path) -> bool:
        return bool(_files(root))

    def read(self, data: Data) -> RawDataset:
        path = one_file(data.path, _files(data.path), f"file *{CAMERAS}; copy 1_initial/params of the project there")
        project = path.name.removesuffix(CAMERAS)
        cameras = _cameras(path)
        offset = _offset(path, project, cameras)
        found, shots, lenses = photographs(data, [camera.name for camera in cameras]), [], LensTable(path)
        for camera in cameras:
            if camera.name in found:
                with leaving_out():
                    lens = lenses.camera(f"{path}: {camera.name}", camera.lens(path))
                    pose = pose_at(f"{path}: {camera.name}", camera.turn, camera.centre + offset)
                    shots.append(RawImage(camera.name, pose, lens, found[camera.name]))
        lenses.tell()
        crs, metres = _crs(path.with_name(f"{project}{CRS}"))
        return RawDataset(
            shots, *points(data.path, {}), metres=metres, crs=crs, shift=tuple(offset) if any(offset) else None
        )


@dataclass(frozen=True)
class _Camera:
    """A photograph as the file has it: size, K, distortion, rotation from the world, centre less the offset."""

    name: str
    size: tuple[int, int]
    matrix: np.ndarray
    radial: np.ndarray
    tangential: np.ndarray
    turn: np.ndarray
    centre: np.ndarray

    def lens(self, path: Path) -> Brown:
        """Of its numbers, or BadInput."""
        where, k = f"{path}: {self.name}", self.matrix
        if any(k[(1, 2, 2), (0, 0, 1)]) or k[2, 2] != 1:
            raise BadInput(f"{where}: the camera matrix has entries below its diagonal; export the parameters again")
        k1, k2, k3 = (float(value) for value in self.radial)
        tangential = (float(self.tangential[0]), float(self.tangential[1]))
        focal, centre = (float(k[0, 0]), float(k[1, 1])), (float(k[0, 2]), float(k[1, 2]))
        return Brown(self.size, focal, centre, (k1, k2, k3, 0.0), tangential, shear=float(k[0, 1]))


def _files(root: Path) -> list[Path]:
    """The files of cameras, in the first folder that has some."""
    for folder in PARAMETER_FOLDERS:
        if found := sorted(path for path in (root / folder).glob(f"*{CAMERAS}") if path.is_file()):
            return found
    return []


def _cameras(path: Path) -> list[_Camera]:
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    if not lines or lines[0] != "fileName imageWidth imageHeight":
        raise BadInput(f"{path}: does not begin with 'fileName imageWidth imageHeight'; export the parameters again")
    at, fields = 1, []
    while at < len(lines) and not lines[at].startswith("camera model"):
        found = MATRIX_PATTERN.fullmatch(lines[at])
        if found is None or MATRIX_SHAPES.get(found[1]) != (int(found[2]), int(found[3])):
            raise BadInput(
                f"{path}: {lines[at][:60]!r} is none of {', '.join(MATRIX_SHAPES)}: only perspective cameras are "
                f"read; for "
                "others, use undistorted photographs"
            )
        fields.append(found[1])
        at += 1
    if lacking := [name for name in MATRIX_SHAPES if name not in fields and "distortion" not in name]:
        raise BadInput(f"{path}: its list of contents lacks {', '.join(lacking)}; export the parameters again")
    body = lines[at + 1 :]
    rows = [MATRIX_SHAPES[name] if MATRIX_SHAPES[name][1] > 1 else (1, MATRIX_SHAPES[name][0]) for name in fields]
    each = 1 + sum(height for height, _ in rows)
    if not body or len(body) % each:
        raise BadInput(f"{path}: {len(body)} lines of cameras, of which each takes {each}: cut off; export it again")
    cameras = []
    for start in range(0, len(body), each):
        with leaving_out():
            cameras.append(_one(path, body[start : start + each], dict(zip(fields, rows, strict=True))))
    return cameras


def _one(path: Path, lines: list[str], shapes: dict[str, tuple[int, int]]) -> _Camera:
    words = lines[0].rsplit(maxsplit=2)
    if len(words) != 3 or not all(word.isascii() and word.isdigit() and len(word) < 9 for word in words[1:]):
        raise BadInput(f"{path}: {lines[0][:60]!r} is no photograph with its width and height; export it again")
    name, at = words[0].replace("\\", "/"), 1
    values = {"radial distortion": np.zeros(3), "tangential distortion": np.zeros(2)}
    for field, (height, width) in shapes.items():
        where = f"{path}: {field} of {name}"
        values[field] = np.stack([numbers(where, line, width) for line in lines[at : at + height]]).squeeze()
        at += height
    return _Camera(name, (int(words[1]), int(words[2])), *(values[field] for field in _ORDER))


_ORDER = ("camera matrix K", "radial distortion", "tangential distortion", "camera rotation R", "camera position t")


def _offset(path: Path, project: str, cameras: list[_Camera]) -> np.ndarray:
    """(3,) what positions leave out: as the file of the offset says, or as the positions with it do."""
    own, full = path.with_name(f"{project}{OFFSET}"), path.with_name(f"{project}{EXTERNAL}")
    if own.is_file():
        return numbers(str(own), read_text(own), 3)
    if full.is_file():
        placed = {}
        for line in read_text(full).splitlines()[1:]:
            words = line.rsplit(maxsplit=6)
            if len(words) == 7:
                placed[words[0].replace("\\", "/")] = numbers(f"{full}: {words[0]}", words[1:4], 3)
        offsets = [placed[camera.name] - camera.centre for camera in cameras if camera.name in placed]
        if offsets:
            middle = np.median(offsets, axis=0)
            if np.abs(offsets - middle).max() > MAX_OFFSET_DIFFERENCE:
                raise BadInput(f"{full}: its positions are not those of {path.name} and one offset; export both again")
            return np.round(middle, 3)
    emit(Warned(f"{path}: no {own.name} beside it: coordinates are those of the file, which may lack an offset"))
    return np.zeros(3)


def _crs(path: Path) -> tuple[str | None, float | None]:
    """The coordinate reference system, and metres per unit of it."""
    if not path.is_file():
        return None, None
    text = " ".join(read_text(path).split())
    given = from_wkt(str(path), text)
    flat = in_plan(given)
    if not flat.is_projected:
        emit(Warned(f"{path}: {given.name!r} is no projected coordinate reference system, and is left out"))
        return None, None
    return code_in_plan(str(path), given) or text, metres_of(flat)
