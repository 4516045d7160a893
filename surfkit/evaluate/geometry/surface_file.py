"""Meshes and clouds of points from files, however large: positions stay on disk until a block of them is asked for."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.optional import needed
from surfkit.evaluate.geometry.file_transform import notes_in, offset_in, place_of, root_of
from surfkit.evaluate.geometry.heights import RASTERS, raster_system, read_heights_raster
from surfkit.evaluate.geometry.las import CLOUDS, SCANS, las_notes, read_e57, read_las
from surfkit.evaluate.geometry.ply_lists import fans, has_lists, points_beside_lists
from surfkit.io.datasets.sparse_ply import read_points
from surfkit.io.splats.ply import PLY_TYPES, read_vertices

BLOCK_POINTS = 1 << 20
"""Points in memory at a time."""
FACE_PROPERTIES = ("vertex_indices", "vertex_index")
"""Names that PLY files give to the corners of a face."""
BOX_PIECES = 16
"""Into which the diagonal of a box is cut by faces that reach out of it."""

Blocks = Callable[[], Iterator[np.ndarray]]
"""Begins anew with every call: (n, 3) float64 positions, block by block."""


@dataclass(frozen=True)
class SurfaceFile:
    """What a file holds: a mesh, or a cloud of points.

    Attributes:
        path: The file.
        rows: (V,) records with fields x, y, z, which may lie on disk, or a plain (V, 3) array.
        faces: (F, 3) rows of the corners; None for a cloud.
        offset: What coordinates in `rows` leave out.
    """

    path: Path
    rows: np.ndarray
    faces: np.ndarray | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def triangles(self) -> np.ndarray:
        """The faces of a mesh; ValueError for a cloud."""
        if self.faces is None:
            raise ValueError(f"{self.path}: a cloud of points, which has no faces; ask for `faces` first")
        return self.faces

    def vertices(self, part: slice | np.ndarray = slice(None)) -> np.ndarray:
        """(n, 3) float64 of all vertices, or of some."""
        if self.rows.dtype.names is None:
            return np.asarray(self.rows[part], np.float64) + self.offset
        rows = self.rows[part]
        return np.stack([rows[axis] for axis in "xyz"], axis=1, dtype=np.float64) + self.offset

    def blocks(self) -> Iterator[np.ndarray]:
        """(n, 3) float64 finite positions of the vertices, block by block."""
        for start in range(0, len(self), BLOCK_POINTS):
            block = self.vertices(slice(start, start + BLOCK_POINTS))
            yield block[np.isfinite(block).all(1)]


def system_of(path: Path) -> str | None:
    """The coordinate reference system that a LAS file, a raster of heights or a PLY file of surfkit names, with what
    heights are above if it says so; None where there is none."""
    if path.suffix.lower() == ".ply":
        return notes_in("\n".join(_header(path))).get("crs")
    if path.suffix.lower() in CLOUDS:
        return las_notes(path).get("system")
    return raster_system(path) if path.suffix.lower() in RASTERS else None


def metres_in(path: Path) -> float | None:
    """Metres per unit, as surfkit writes it into PLY files; None where the file does not say.

    Raises:
        BadInput: It says something else than a length.
    """
    if path.suffix.lower() != ".ply":
        return None
    told = notes_in("\n".join(_header(path))).get("metres per unit")
    try:
        metres = None if told is None else float(told)
    except ValueError:
        metres = 0.0
    if metres is not None and not 0 < metres < np.inf:
        raise BadInput(f"{path}: comment metres per unit: {told}: it must be a number above 0; write the file again")
    return metres


def part_within(mesh: SurfaceFile, low: np.ndarray, high: np.ndarray) -> SurfaceFile:
    """The faces of a mesh that reach into a box; of those that reach far out of it, pieces.

    Args:
        mesh: With faces.
        low: (3,) least coordinates of the box.
        high: (3,) greatest.
    """
    found, piece = [], float(np.linalg.norm(high - low)) / BOX_PIECES
    for start in range(0, len(mesh.triangles), BLOCK_POINTS):
        corners = mesh.vertices(np.asarray(mesh.triangles[start : start + BLOCK_POINTS]).ravel()).reshape(-1, 3, 3)
        while len(corners):
            least, most = corners.min(1), corners.max(1)
            touches = ((least <= high) & (most >= low)).all(1)
            far = touches & ((least < low) | (most > high)).any(1) & (np.ptp(corners, axis=1).max(1) > piece)
            found.append(corners[touches & ~far])
            a, b, c = corners[far].transpose(1, 0, 2)
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
            corners = np.concatenate([np.stack(each, axis=1) for each in quarters])
    corners = np.concatenate(found) if found else np.empty((0, 3, 3))
    return SurfaceFile(mesh.path, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def read_surface(path: Path) -> SurfaceFile:
    """The mesh or cloud in a file: PLY read here, block by block; OBJ, STL, GLB, OFF and text PLY meshes by trimesh;
    LAS, LAZ and E57 by their libraries, and rasters of heights as meshes.

    Meshes of surfkit that leave out an offset, or are turned, are brought back to the coordinates of the input.
    Points that are not finite are left out, with a warning, and so are faces at such vertices.

    Raises:
        BadInput: No such file, damaged, without points, or a mesh without faces.
    """
    if path.is_dir():
        raise BadInput(f"{path}: a folder; name the file of a mesh or a cloud of points in it")
    if not path.is_file():
        raise BadInput(f"{path}: no such file; name a mesh or a cloud of points")
    kind = path.suffix.lower()
    if kind in SCANS:
        found = SurfaceFile(path, read_e57(path) if kind == ".e57" else read_las(path)[0])
    elif kind in RASTERS:
        found = SurfaceFile(path, *read_heights_raster(path))
    else:
        found = _ply(path) if kind == ".ply" else _other(path)
    if not len(found):
        raise BadInput(f"{path}: no points in it; write the file again")
    if found.faces is not None and not len(found.faces):
        raise BadInput(f"{path}: a mesh without faces, so there is no surface to measure; make the mesh again")
    return _sound(found)


def read_mesh(path: Path) -> SurfaceFile:
    """The mesh in a file; BadInput for a cloud of points."""
    found = read_surface(path)
    if found.faces is None:
        raise BadInput(f"{path}: a cloud of points; name a mesh")
    return found


def _ply(path: Path) -> SurfaceFile:
    lines = _header(path)
    count = next((int(line.split()[2]) for line in lines if line.startswith("element face ")), None)
    if "format binary_little_endian 1.0" in lines:
        rows = points_beside_lists(path, lines) if count is None and has_lists(lines) else read_vertices(path)[0]
        if not {"x", "y", "z"} <= set(rows.dtype.names or ()):
            raise BadInput(f"{path}: its points lack x, y or z; write the file again")
        return SurfaceFile(
            path, rows, None if count is None else _faces(path, lines, rows, count), offset_in(path, lines)
        )
    if count is None:
        return SurfaceFile(path, read_points(path)[0])
    return _other(path)


def _header(path: Path) -> list[str]:
    """Lines of a PLY header; that it ends is for `read_vertices` to check."""
    try:
        with path.open("rb") as file:
            head = file.read(1 << 16)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    if not head.startswith(b"ply"):
        raise BadInput(f"{path}: no PLY file: it does not begin with 'ply'")
    text = head.partition(b"end_header")[0].decode("ascii", "replace")
    lines = [" ".join(line.split()) for line in text.replace("\r", "\n").split("\n")]
    for line in lines:
        if line.startswith("element ") and not (len(line.split()) == 3 and line.split()[2].isdecimal()):
            raise BadInput(f"{path}: cannot read {line!r} in the PLY header; write the file again")
    return lines


def _faces(path: Path, lines: list[str], rows: np.ndarray, count: int) -> np.ndarray:
    """(F, 3) corners, mapped from a binary file whose faces come after its vertices; fans of larger polygons."""
    elements = [line.split()[1] for line in lines if line.startswith("element ")]
    if elements[1] != "face":
        raise BadInput(f"{path}: element {elements[1]!r} lies before the faces; write vertices, then faces")
    begun = lines.index(f"element face {count}") + 1
    ends = [i for i, line in enumerate(lines) if i > begun and line.startswith("element ")]
    fields: list[tuple] = []
    for words in (line.split() for line in lines[begun : ends[0] if ends else None] if line.startswith("property ")):
        if (
            words[1] == "list"
            and len(words) == 5
            and words[4] in FACE_PROPERTIES
            and {words[2], words[3]} <= PLY_TYPES.keys()
        ):
            fields += [("size", "<" + PLY_TYPES[words[2]]), ("corners", "<" + PLY_TYPES[words[3]], (3,))]
        elif len(words) == 3 and words[1] in PLY_TYPES:
            fields.append((words[2], "<" + PLY_TYPES[words[1]]))
        else:
            raise BadInput(f"{path}: cannot read {' '.join(words)!r} of a face; leave it out of the file")
    dtype = np.dtype(fields)
    if "corners" not in (dtype.names or ()):
        raise BadInput(f"{path}: its faces have no {FACE_PROPERTIES[0]}; write the file again")
    if not count:
        return np.empty((0, 3), np.int32)
    start = (rows.offset + rows.nbytes) if isinstance(rows, np.memmap) else 0
    size = path.stat().st_size
    if not start:
        raise BadInput(f"{path}: its faces cannot be found; write the file again")
    whole = min(count, (size - start) // dtype.itemsize)
    mapped = np.memmap(path, dtype, "r", start, (whole,)) if whole else np.empty(0, dtype)
    if (mapped["size"] != 3).any():
        return fans(path, dtype, start, count)
    if whole < count:
        raise BadInput(f"{path}: {whole} of {count} triangles in it: it is cut off; write or copy it again")
    return mapped["corners"]


def _other(path: Path) -> SurfaceFile:
    with needed("trimesh", f"{path}: a file that is not binary PLY"):
        import trimesh
    try:
        source = _with_doubles(path) if path.suffix.lower() == ".ply" else path
        loaded = trimesh.load(source, file_type=path.suffix.lower().removeprefix("."), process=False)
        if isinstance(loaded, trimesh.Scene):
            loaded = loaded.to_geometry()
    except Exception as error:  # trimesh's readers raise whatever their parsing runs into
        raise BadInput(f"{path}: cannot be read as a mesh or cloud: {' '.join(str(error).split())}") from error
    vertices, faces = getattr(loaded, "vertices", None), getattr(loaded, "faces", None)
    if vertices is None:
        raise BadInput(f"{path}: no mesh and no cloud of points in it")
    place = place_of(path, root_of(path))
    vertices = np.asarray(vertices, np.float64) @ place.turn.T + place.offset
    return SurfaceFile(path, vertices, None if faces is None else np.asarray(faces))


def _with_doubles(path: Path) -> BinaryIO:
    """A PLY file; in that of a text, coordinates are called doubles: trimesh would round those of a map to half a
    metre, while the text has all their digits."""
    head, end, rest = path.read_bytes().partition(b"end_header")
    if re.search(rb"^format ascii ", head, re.MULTILINE):
        head = re.sub(rb"^property float(32)? (?=[xyz]\s*$)", b"property double ", head, flags=re.MULTILINE)
    return io.BytesIO(head + end + rest)


def rounding(surface: SurfaceFile) -> float:
    """Step between neighbouring numbers at the largest coordinate, in units of the file, where all coordinates are
    numbers of 32 bits, whatever the file calls them; 0 where they have more digits."""
    some = surface.vertices(slice(None, None, max(1, len(surface) // BLOCK_POINTS))) - surface.offset
    some = some[np.isfinite(some).all(1)]
    if not len(some) or (some.astype(np.float32) != some).any():
        return 0.0
    return float(np.spacing(np.abs(some).max().astype(np.float32)))


def _sound(found: SurfaceFile) -> SurfaceFile:
    """The same without what is not finite, told by a warning; faces must name vertices that are there."""
    starts = range(0, len(found), BLOCK_POINTS)
    good = [np.isfinite(found.vertices(slice(start, start + BLOCK_POINTS))).all(1) for start in starts]
    bad = len(found) - sum(int(part.sum()) for part in good)
    if bad == len(found):
        raise BadInput(f"{found.path}: none of its {bad} points is finite; write the file again")
    faces = found.faces
    if faces is not None:
        low, high = int(faces.min()), int(faces.max())
        if low < 0 or high >= len(found):
            raise BadInput(
                f"{found.path}: a face names vertex {high if low >= 0 else low} of {len(found)}; write it again"
            )
    if bad:
        emit(Warned(f"{found.path}: {bad} of {len(found)} points are not finite and are left out"))
    if bad and faces is not None:
        faces = faces[np.concatenate(good)[faces].all(1)]
        if not len(faces):
            raise BadInput(f"{found.path}: no face with finite corners; make the mesh again")
    return replace(found, faces=faces)
