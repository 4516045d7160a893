"""BlocksExchange XML of ContextCapture and iTwin Capture, which DJI Terra, Metashape and RealityCapture write too.

The comments of Bentley's sample file, and its page "CC Orientations", say what the numbers mean: a rotation brings the
world to the camera, whose axes CameraOrientation names; pixels are counted from the centre of the first pixel;
SensorSize is that of the longer side. Omega, phi and kappa are those that the sample gives beside its matrix.
Distortion is Brown's as Wikipedia has it: P1 goes with r^2 + 2 x^2, where OpenCV has p2.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.core.events import Warned, emit
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import MAX_DIFFERENCE_PX, Brown, LensTable
from surfkit.io.datasets.camera_files import (
    groups_of,
    leave_out,
    numbers,
    one_file,
    photographs,
    pose_at,
    tracks_of,
)
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.exchange_formats import map_system, photo_names
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage, Tracks
from surfkit.io.datasets.transforms import points

SNIFFED_BYTES = 4096
"""Bytes of a file that are looked at to recognise it."""
CHUNK_BYTES = 1 << 20
"""Bytes of a file that are read at once."""
FIRST_PIXEL_CENTRE = 0.5
"""Of the first pixel, from the corner of the picture; it is at 0 in the file."""
SIDE_DIRECTIONS = {"Right": (1.0, 0.0), "Left": (-1.0, 0.0), "Down": (0.0, 1.0), "Up": (0.0, -1.0)}
"""Directions in the picture: right and down."""
MATRIX = tuple(f"M_{row}{column}" for row in range(3) for column in range(3))
ANGLES = ("Omega", "Phi", "Kappa")


@dataclass(frozen=True)
class BlocksExchange(Reader):
    """BlocksExchange XML (DJI Terra, ContextCapture, iTwin Capture) and images/; tie points with their tracks."""

    def recognises(self, root: Path) -> bool:
        return bool(_files(root))

    def read(self, data: Data) -> RawDataset:
        block = _Block.read(data)
        shots, seen = block.shots(data), block.seen()
        crs, metres = block.place()
        xyz, rgb = (block.xyz, block.rgb) if len(block.xyz) else points(data.path, {})
        return RawDataset(shots, xyz, rgb, metres=metres, crs=crs, groups=groups_of(shots, seen))

    def tracks(self, data: Data) -> Tracks | None:
        block = _Block.read(data)
        return tracks_of(block.shots(data), block.xyz, block.seen()) if len(block.xyz) else None


class _Tree(ElementTree.TreeBuilder):
    """The elements of a file, less its tie points, of which there may be millions: their numbers alone are kept.

    Attributes:
        xyz, rgb: Of the tie points that have a position.
        sights: Row of xyz, number of the photograph, and pixel as the file has it.
    """

    def __init__(self, path: Path):
        super().__init__()
        self._path = path
        self.xyz: list[list[float]] = []
        self.rgb: list[list[float]] = []
        self.sights: list[tuple[int, str, float, float]] = []

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        """Refuse definitions, which may expand to anything."""
        raise BadInput(f"{self._path}: has definitions of its own, which BlocksExchange has not; export again")

    def end(self, tag: str) -> ElementTree.Element:
        element = super().end(tag)
        if tag == "TiePoint":
            with leaving_out():
                self._keep(element)
            element.clear()
        return element

    def _keep(self, point: ElementTree.Element) -> None:
        position, color = point.find("Position"), point.find("Color")
        if position is None:
            return
        where = f"{self._path}: tie point {len(self.xyz) + 1}"
        xyz = _texts(where, position, "xyz")
        self.rgb.append([0.5] * 3 if color is None else _texts(where, color, ("Red", "Green", "Blue")))
        self.xyz.append(xyz)
        for seen in point.iterfind("Measurement"):
            if seen.find("x") is not None:  # others are in millimetres
                x, y = _texts(where, seen, "xy")
                self.sights.append((len(self.xyz) - 1, _text(seen, "PhotoId"), x, y))


@dataclass(frozen=True)
class _Block:
    """What the file says.

    Attributes:
        path: Of the file.
        systems: Definitions of coordinate reference systems, by their number.
        block: The block of most photographs.
        photos: Photographs with a pose, of the largest component, and their groups.
        names: Of these.
        xyz, rgb: (P, 3) float64 and uint8.
        rows, pixels: (K,) int64 of xyz; (K, 2) float64.
        seers: Number of the photograph of each pixel.
    """

    path: Path
    systems: dict[str, str]
    block: ElementTree.Element
    photos: list[tuple[ElementTree.Element, ElementTree.Element]]
    names: list[str]
    xyz: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    rgb: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    seers: Sequence[str] = ()

    @classmethod
    def read(cls, data: Data) -> _Block:
        """The file of a data set, or BadInput."""
        path = one_file(data.path, _files(data.path), "BlocksExchange XML file; export it, with the tie points")
        root, tree = _parse(path)
        blocks = root.findall("Block")
        if not blocks:
            raise BadInput(f"{path}: no Block in it; export the block again")
        block = max(blocks, key=lambda one: len(one.findall("Photogroups/Photogroup/Photo")))
        photos = _photos(path, block)
        names = photo_names([_text(photo, "ImagePath") for photo, _ in photos])
        systems = {
            _text(each, "Id"): _text(each, "Definition") for each in root.iterfind("SpatialReferenceSystems/SRS")
        }
        found = cls(path, systems, block, photos, names)
        if why := _tie_points_fault(block, len(blocks)):
            emit(Warned(f"{path}: {why}"))
            return found
        if not tree.xyz:
            return found
        pixels = np.array([sight[2:] for sight in tree.sights], np.float64).reshape(-1, 2) + FIRST_PIXEL_CENTRE
        return replace(
            found,
            xyz=np.array(tree.xyz),
            rgb=(np.array(tree.rgb).clip(0, 1) * 255).round().astype(np.uint8),
            rows=np.array([sight[0] for sight in tree.sights], np.int64),
            pixels=pixels,
            seers=[sight[1] for sight in tree.sights],
        )

    def shots(self, data: Data) -> list[RawImage]:
        """The photographs that have a lens and a pose."""
        found, shots, lenses = photographs(data, self.names), [], LensTable(self.path)
        made, used = {}, {group for _, group in self.photos}
        for at, group in enumerate(self.block.iterfind("Photogroups/Photogroup"), 1):
            if group in used:
                with leaving_out():
                    where = f"{self.path}: photogroup {_text(group, 'Name') or at!r}"
                    axes = _axes(where, group)
                    made[group] = axes, lenses.camera(where, self._lens(where, group, axes))
        lenses.tell()
        for name, (photo, group) in zip(self.names, self.photos, strict=True):
            if name in found and group in made:
                with leaving_out():
                    axes, camera = made[group]
                    shots.append(RawImage(name, _pose(f"{self.path}: {name!r}", photo, axes), camera, found[name]))
        return shots

    def seen(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """By name of the photograph: rows of xyz, and pixels."""
        named = {_text(photo, "Id"): name for name, (photo, _) in zip(self.names, self.photos, strict=True)}
        listed: dict[str, list[int]] = {}
        for at, number in enumerate(self.seers):
            if number in named:
                listed.setdefault(named[number], []).append(at)
        return {name: (self.rows[at], self.pixels[at]) for name, at in listed.items()}

    def place(self) -> tuple[str | None, float | None]:
        """The coordinate reference system, and metres per unit of it; None where it is local."""
        number = _text(self.block, "SRSId")
        text = " ".join(self.systems.get(number, "").split())
        return map_system(f"{self.path}: coordinate reference system {text[:40]!r}", text) if text else (None, None)

    def _lens(self, where: str, group: ElementTree.Element, axes: np.ndarray) -> Brown:
        """The lens of a photogroup; `axes` are those of its cameras."""
        kind, system = _text(group, "CameraModelType") or "Perspective", _text(group, "SRSId")
        if kind != "Perspective":
            raise BadInput(
                f"{where}: its cameras are of type {kind}; only Perspective is read: use undistorted photographs"
            )
        if system not in ("", _text(self.block, "SRSId")):
            raise BadInput(f"{where}: it has a coordinate reference system of its own; export the block in one")
        width, height = (_number(where, group, f"ImageDimensions/{side}") for side in ("Width", "Height"))
        longer, centre = max(width, height), [width / 2, height / 2]
        pixel = _number(where, group, "PixelSize", 0.0) or _number(where, group, "SensorSize", 0.0) / max(longer, 1)
        focal = _number(where, group, "FocalLengthPixels", 0.0)
        if not focal:
            if not pixel > 0:
                raise BadInput(f"{where}: no FocalLengthPixels, and no SensorSize either; export the block again")
            focal = _number(where, group, "FocalLength") / pixel
        if group.find("PrincipalPoint/x") is not None:
            centre = [_number(where, group, f"PrincipalPoint/{axis}") + FIRST_PIXEL_CENTRE for axis in "xy"]
        elif group.find("PrincipalPoint/xmm") is not None:
            if not pixel > 0:
                raise BadInput(f"{where}: a principal point in millimetres, and no SensorSize; export the block again")
            off = [_number(where, group, f"PrincipalPoint/{axis}mm") for axis in "xy"]
            centre = [middle + shift / pixel for middle, shift in zip(centre, off @ axes[:2, :2], strict=True)]
        aspect, skew = (_number(where, group, name, by) for name, by in (("AspectRatio", 1.0), ("Skew", 0.0)))
        if max(abs(aspect - 1), abs(skew)) * longer / 2 > MAX_DIFFERENCE_PX:
            raise BadInput(
                f"{where}: AspectRatio {aspect:g} and Skew {skew:g}, which programs write in different ways; optimise "
                "the cameras without them, or use undistorted photographs"
            )
        k1, k2, k3, p1, p2 = (
            _number(where, group, f"Distortion/{name}", 0.0) for name in ("K1", "K2", "K3", "P1", "P2")
        )
        return Brown((int(width), int(height)), (focal, focal), (centre[0], centre[1]), (k1, k2, k3, 0.0), (p2, p1))


def _files(root: Path) -> list[Path]:
    """The XML files of a folder that begin as those of blocks do."""
    return sorted(path for path in root.glob("*.xml") if path.is_file() and _is_blocks(path))


def _is_blocks(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return b"<BlocksExchange" in file.read(SNIFFED_BYTES)
    except OSError:
        return False


def _parse(path: Path) -> tuple[ElementTree.Element, _Tree]:
    tree = _Tree(path)
    parser = ElementTree.XMLParser(target=tree)
    try:
        with path.open("rb") as file:
            while part := file.read(CHUNK_BYTES):
                parser.feed(part)
        root = parser.close()
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    except (ElementTree.ParseError, LookupError) as error:
        raise BadInput(f"{path}: not XML, or cut off: {error}; export the block again") from error
    return root, tree


def _tie_points_fault(block: ElementTree.Element, blocks: int) -> str:
    """Why the tie points of a file are not used; "" where they are."""
    if blocks > 1:
        return f"it has {blocks} blocks; the one of most photographs is used, without tie points"
    listed = block.findall("TiePoints")
    for each in listed:
        if outside := _text(each, "Path"):
            return f"tie points lie in {outside!r}, which is not read; export them in the same file"
    if any(_text(each, "SRSId") not in ("", _text(block, "SRSId")) for each in listed):
        return "tie points are in another coordinate reference system than the block, and are left out"
    return ""


def _photos(path: Path, block: ElementTree.Element) -> list[tuple[ElementTree.Element, ElementTree.Element]]:
    """Those with a pose, of the largest component, each with its group."""
    listed = [(photo, group) for group in block.iterfind("Photogroups/Photogroup") for photo in group.iterfind("Photo")]
    if not listed:
        raise BadInput(f"{path}: no photograph in it; export the block again")
    posed = [
        pair for pair in listed if all(pair[0].find(f"Pose/{part}") is not None for part in ("Rotation", "Center"))
    ]
    has = set(posed)
    without = [_text(photo, "ImagePath") for photo, group in listed if (photo, group) not in has]
    leave_out(path, without, len(listed), "have no pose")
    parts = [_text(photo, "Component") or "1" for photo, _ in posed]
    largest = Counter(parts).most_common(1)[0][0]
    apart = [_text(photo, "ImagePath") for (photo, _), part in zip(posed, parts, strict=True) if part != largest]
    leave_out(path, apart, len(posed), "are not of the largest component")
    return [pair for pair, part in zip(posed, parts, strict=True) if part == largest]


def _axes(where: str, group: ElementTree.Element) -> np.ndarray:
    """(3, 3) axes of the cameras of a group, a row each, in a frame with x right, y down, z forward."""
    text = _text(group, "CameraOrientation") or "XRightYDown"
    x, _, y = text.removeprefix("X").partition("Y")
    if (
        not text.startswith("X")
        or x not in SIDE_DIRECTIONS
        or y not in SIDE_DIRECTIONS
        or np.dot(SIDE_DIRECTIONS[x], SIDE_DIRECTIONS[y])
    ):
        raise BadInput(f"{where}: CameraOrientation {text!r} is none such as XRightYDown or XRightYUp; export again")
    right, down = (*SIDE_DIRECTIONS[x], 0.0), (*SIDE_DIRECTIONS[y], 0.0)
    return np.array([right, down, np.cross(right, down)])


def _pose(where: str, photo: ElementTree.Element, axes: np.ndarray) -> np.ndarray:
    """(4, 4) world_to_camera, x right, y down, z forward."""
    rotation, place = photo.find("Pose/Rotation"), photo.find("Pose/Center")
    assert rotation is not None and place is not None, "`_photos` has left out those without"
    centre = np.array(_texts(f"{where}: Center", place, "xyz"))
    if rotation.find("M_00") is not None:
        turn = np.array(_texts(f"{where}: Rotation", rotation, MATRIX)).reshape(3, 3)
    elif rotation.find("Omega") is not None:
        turn = _from_angles(_texts(f"{where}: Rotation", rotation, ANGLES))
    else:
        raise BadInput(f"{where}: its Rotation is no matrix and has no Omega; export the block with one of both")
    return pose_at(where, axes.T @ turn, centre)


def _from_angles(degrees: Sequence[float]) -> np.ndarray:
    """(3, 3) world to camera, of omega, phi and kappa."""
    (co, cp, ck), (so, sp, sk) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, co, so], [0, -so, co]])
    about_y = np.array([[cp, 0, -sp], [0, 1, 0], [sp, 0, cp]])
    about_z = np.array([[ck, sk, 0], [-sk, ck, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _text(element: ElementTree.Element, path: str) -> str:
    return (element.findtext(path) or "").strip()


def _texts(where: str, element: ElementTree.Element, names: Iterable[str]) -> list[float]:
    """Finite numbers of the children of an element, or BadInput."""
    texts = [element.findtext(name) or "" for name in names]
    return numbers(where, texts, len(texts)).tolist()


def _number(where: str, group: ElementTree.Element, path: str, missing: float | None = None) -> float:
    """A number of a group; `missing` where it has none."""
    if missing is not None and group.find(path) is None:
        return missing
    return float(numbers(f"{where}: {path}", [_text(group, path)], 1)[0])
