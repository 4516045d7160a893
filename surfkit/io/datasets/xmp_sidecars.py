"""RealityCapture and RealityScan: an XMP file beside each photograph, of "Metadata (XMP)".

What the numbers mean is said in "RealityCapture XMP Camera Math" of its support pages, and in the writer of such files
in Epic's MetaHuman plugin (DHInputOutput.cpp). The rotation brings the world to the camera (x right, y down, z
forward), row by row; the position is the camera's place. The focal length is that of a film 36 mm wide along the longer
side. The principal point and the skew are shares of the longer side, the former from the middle; fy is fx times the
aspect ratio. The six coefficients are k1 to k4, t1 and t2, of which t1 goes with r^2 + 2 x^2: OpenCV's p1 and p2 are t2
and t1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np

from surfkit.core.check import BadInput, leaving_out
from surfkit.io.datasets.base import Reader
from surfkit.io.datasets.brown import Brown, LensTable
from surfkit.io.datasets.camera_files import leave_out, numbers, photographs, pose_at, read_text
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.raw_dataset import RawDataset, RawImage
from surfkit.io.datasets.realitycapture import FILM_MM
from surfkit.io.datasets.transforms import points
from surfkit.scene.photo_names import PICTURE_SUFFIXES
from surfkit.scene.photos import photo_size

SPACE = "http://www.capturingreality.com/ns/xcr/"
"""What the namespace begins with; its version follows."""
SNIFFED_BYTES = 4096
"""Bytes of a file that are looked at to recognise it."""
TERMS = {"perspective": (0, 0), "brown3": (3, 0), "brown4": (4, 0), "brown3t2": (3, 2), "brown4t2": (4, 2)}
"""Distortion models, and how many radial and tangential coefficients they use."""
DISTORTION_KEYS = ("DistortionCoeficients", "DistortionCoefficients")
"""As RealityCapture spells it, and as it is spelt."""


@dataclass(frozen=True)
class XmpSidecars(Reader):
    """RealityCapture's XMP files beside the photographs: a.xmp for a.jpg, in images/ or beside it."""

    priority: ClassVar[int] = -1
    """They lie beside photographs that other programs have aligned since."""

    def recognises(self, root: Path) -> bool:
        return any(_is_sidecar(path) for path in _sidecars(root, root / "images"))

    def read(self, data: Data) -> RawDataset:
        own = data.path / (data.images or "images")
        folder = own if own.is_dir() else data.path
        files = [path for path in _sidecars(data.path, folder) if _is_sidecar(path)]
        if not files:
            raise BadInput(f"{folder}: no XMP files of RealityCapture beside the photographs; export 'Metadata (XMP)'")
        values = {}
        for path in files:
            with leaving_out():
                values[path] = _values(path)
        posed = [path for path, given in values.items() if {"Rotation", "Position"} <= given.keys()]
        without = [path.name for path in values.keys() - set(posed)]
        leave_out(folder, sorted(without), len(values), "have no pose in their XMP")
        names = _names(folder, posed)
        found, shots, lenses = photographs(data, list(names.values())), [], LensTable(folder)
        for path, name in names.items():
            if name in found:
                with leaving_out():
                    camera = lenses.camera(str(path), _lens(path, values[path], found[name]))
                    shots.append(RawImage(name, _pose(path, values[path]), camera, found[name]))
        lenses.tell()
        return RawDataset(shots, *points(data.path, {}))


def _sidecars(root: Path, folder: Path) -> list[Path]:
    """The XMP files in a data set, or in the folder of its photographs and below."""
    return sorted({*root.glob("*.[xX][mM][pP]"), *(folder.rglob("*.[xX][mM][pP]") if folder.is_dir() else ())})


def _is_sidecar(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return SPACE.encode() in file.read(SNIFFED_BYTES)
    except OSError:
        return False


def _values(path: Path) -> dict[str, str]:
    """What RealityCapture says of a photograph, by name."""
    text = read_text(path)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise BadInput(f"{path}: has definitions of its own, which XMP has not; export it again")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise BadInput(f"{path}: not XML: {error}; export the XMP files again") from error
    found: dict[str, str] = {}
    for element in root.iter():
        pairs = [*element.attrib.items(), (str(element.tag), element.text or "")]
        found |= {name.rpartition("}")[2]: value.strip() for name, value in pairs if name.startswith(f"{{{SPACE}")}
    return found


def _names(folder: Path, files: list[Path]) -> dict[Path, str]:
    """The photograph of each file, of the same name but its ending; that name alone where there is none or several."""
    photos: dict[Path, list[Path]] = {}
    for photo in sorted(folder.rglob("*")):
        if photo.suffix.lower() in PICTURE_SUFFIXES:
            photos.setdefault(photo.with_suffix(""), []).append(photo)
    names = {}
    for path in files:
        inside = path if path.is_relative_to(folder) else folder / path.name
        same = photos.get(inside.with_suffix(""), [])
        place = same[0] if len(same) == 1 else inside.with_suffix("")
        names[path] = place.relative_to(folder).as_posix()
    return names


def _pose(path: Path, values: Mapping[str, str]) -> np.ndarray:
    turn = numbers(f"{path}: xcr:Rotation", values["Rotation"], 9).reshape(3, 3)
    return pose_at(str(path), turn, numbers(f"{path}: xcr:Position", values["Position"], 3))


def _lens(path: Path, values: Mapping[str, str], photo: Path) -> Brown:
    def number(name: str, missing: str | None = None) -> float:
        text = values.get(name, missing)
        if text is None:
            raise BadInput(f"{path}: no xcr:{name}; export the XMP files with the calibration of the cameras")
        return float(numbers(f"{path}: xcr:{name}", [text], 1)[0])

    model = values.get("DistortionModel", "perspective")
    text = next((values[name] for name in DISTORTION_KEYS if name in values), "")
    given = numbers(f"{path}: xcr:{DISTORTION_KEYS[0]}", text, len(text.split())).tolist()
    if len(given) > 6 or (any(given) and model not in TERMS):
        raise BadInput(
            f"{path}: distortion model {model!r} with {len(given)} coefficients; known: {', '.join(TERMS)}, of six "
            "coefficients at most; choose one of them in the alignment settings, and export again"
        )
    radial, tangential = TERMS.get(model, (0, 0))
    given += [0.0] * (6 - len(given))
    k1, k2, k3, k4 = (value if at < radial else 0.0 for at, value in enumerate(given[:4]))
    t1, t2 = given[4:] if tangential else (0.0, 0.0)
    width, height = photo_size(photo)
    longer = max(width, height)
    focal = number("FocalLength35mm") / FILM_MM * longer
    centre = [
        number(f"PrincipalPoint{axis}", "0") * longer + side / 2
        for axis, side in zip("UV", (width, height), strict=True)
    ]
    return Brown(
        size=(width, height),
        focal=(focal, focal * number("AspectRatio", "1")),
        centre=(centre[0], centre[1]),
        radial=(k1, k2, k3, k4),
        tangential=(t2, t1),
        shear=number("Skew", "0") * longer,
    )
