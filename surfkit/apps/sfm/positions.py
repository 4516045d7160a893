"""Where photographs were taken, by the best source for each: a list, EXIF, or XMP; what is doubtful is said.

A position without the letters of the hemisphere (N or S, E or W) has no sign. It is that of XMP, or of photographs near
by that have letters; what is still open has several readings, among which the cameras decide
(`surfkit.apps.sfm.map_choice`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from surfkit.apps.sfm.exif import Exif, Position
from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.position_list import Listed, read_list
from surfkit.apps.sfm.settings import Settings
from surfkit.apps.sfm.survey_plausibility import MAX_POSITION_ERROR_M, MIN_LAND_M
from surfkit.core.check import BadInput, few
from surfkit.core.events import Warned, emit
from surfkit.scene.earth import geocentric

GEO_FILE = "geo.txt"
"""List of OpenDroneMap, beside the photographs or in the folder above."""
GEODETIC_AXES = ("latitude", "longitude")
LETTERS = {"latitude": "N or S", "longitude": "E or W"}
NEAR_DEGREES = 1.0
"""Photographs of one survey are nearer to one another."""
LOWEST_M = -500.0
"""No land is lower."""
APART_M = 100.0
"""EXIF and XMP of a photograph that differ by more contradict each other."""


@dataclass(frozen=True)
class Positions:
    """Photographs, with the position that counts for each.

    Attributes:
        photos: In the order given.
        crs: The map that a list of positions is on; None without.
    """

    photos: list[Photo]
    crs: str | None = None

    @property
    def open(self) -> tuple[str, ...]:
        """Of latitude and longitude, those whose sign is not known in some photograph."""
        return tuple(axis for axis in GEODETIC_AXES if any(axis in photo.exif.unsigned for photo in self.photos))

    def readings(self) -> list[list[Photo]]:
        """The photographs with each choice of the signs that are not known; one list where all are."""
        axes = self.open  # found by a look at every photograph
        return [
            [_signed(photo, dict(zip(axes, signs, strict=True))) for photo in self.photos]
            for signs in itertools.product((1, -1), repeat=len(axes))
        ]


def settle(photos: Sequence[Photo], root: Path, settings: Settings) -> Positions:
    """The position that counts for each photograph.

    That of `--positions` comes first, then that of geo.txt, of EXIF, and of XMP.

    Args:
        photos: Usable ones.
        root: Their folder.
        settings: Names the list, if there is one.

    Raises:
        BadInput: A list cannot be used; says where.
    """
    photos, crs = _by_list(photos, root, settings)
    photos = _by_xmp(photos)
    photos = _by_neighbours(photos)
    return Positions(_heights(photos), crs)


def _by_list(photos: Sequence[Photo], root: Path, settings: Settings) -> tuple[list[Photo], str | None]:
    """The photographs with the positions of a list, and its map."""
    if settings.positions is not None:
        path, said = settings.positions, f"--positions {settings.positions}"
        found = _named(read_list(path, said, settings.positions_crs), photos, said)
        if not found.positions:
            raise BadInput(f"{said}: it names none of the {len(photos)} photographs, such as {photos[0].name!r}")
    else:
        near = next((path for path in (root / GEO_FILE, root.absolute().parent / GEO_FILE) if path.is_file()), None)
        if near is None:
            return list(photos), None
        said = str(near)
        try:
            found = _named(read_list(near, said), photos, said)
        except BadInput as error:
            raise BadInput(
                f"{error}; {GEO_FILE} is read as OpenDroneMap's list of positions: mend it, or rename it"
            ) from error
        if not found.positions:
            emit(Warned(f"{said} names none of the photographs and is not used"))
            return list(photos), None
    given = [name for name, position in found.positions.items() if position is not None]
    own = sum(photo.name in found.positions and photo.exif.position is not None for photo in photos)
    others = [photo.name for photo in photos if photo.name not in found.positions]
    rest = f"; {len(others)} are not in it, and keep the position in EXIF if they have one" if others else ""
    rest += f": {few(others)}" if others else ""
    instead = f", instead of those in EXIF of {own}" if own else ""
    emit(Warned(f"{said} gives the positions of {len(given)} photographs in {found.named}{instead}{rest}"))
    if settings.crs == "auto" and (lost := next(filter(None, (each.lost_heights for each in found.systems)), "")):
        emit(Warned(f"{said}: {lost}"))
    listed = [_listed(photo, found) for photo in photos]
    away = [
        _distance(before.exif.position, after.exif.position)
        for before, after in zip(photos, listed, strict=True)
        if after is not before and not before.exif.unsigned
        if before.exif.position is not None and after.exif.position is not None
    ]
    if away and np.median(away) > MAX_POSITION_ERROR_M:
        emit(
            Warned(
                f"{said} puts the photographs {np.median(away) / 1000:.0f} km from their positions in EXIF: is its "
                "system the right one, with x east and y north?"
            )
        )
    return listed, found.crs


def _listed(photo: Photo, found: Listed) -> Photo:
    """The photograph with its position in the list, or with none where the list has it disabled."""
    if photo.name not in found.positions:
        return photo
    plain = replace(
        photo.exif, unsigned=(), no_reference=False, zero=None, xmp_position=None, xmp_altitude=None, above_start=None
    )
    return replace(
        photo, exif=replace(plain, position=found.positions[photo.name], accuracy_m=found.accuracies.get(photo.name))
    )


def _named(listed: Listed, photos: Sequence[Photo], said: str) -> Listed:
    """The list by the full names of photographs; it may leave out folders and endings, and write capitals otherwise."""
    forms: tuple[Callable[[str], str], ...] = (
        str,
        _without_folder,
        lambda name: _without_folder(name).lower(),
        _bare,
    )
    tables: list[dict[str, list[str]]] = []
    for form in forms:
        table: dict[str, list[str]] = {}
        for photo in photos:
            table.setdefault(form(photo.name), []).append(photo.name)
        tables.append(table)
    found: dict[str, str] = {}
    unknown = []
    for name in listed.positions:
        names = next((table[form(name)] for form, table in zip(forms, tables, strict=True) if form(name) in table), [])
        if len(names) > 1:
            raise BadInput(f"{said}: {name!r} may be {few(names)}; write the folder and the ending too")
        if not names:
            unknown.append(name)
        elif (other := found.setdefault(names[0], name)) != name:
            raise BadInput(f"{said}: {other!r} and {name!r} both name the photograph {names[0]!r}; keep one")
    if unknown and found:
        emit(Warned(f"{said}: {len(unknown)} of its photographs are not in the folder: {few(unknown)}"))
    return Listed(
        {full: listed.positions[name] for full, name in found.items()},
        {full: listed.accuracies[name] for full, name in found.items() if name in listed.accuracies},
        listed.systems,
    )


def _without_folder(name: str) -> str:
    return name.replace("\\", "/").rpartition("/")[2]


def _bare(name: str) -> str:
    """The name without folder and ending, in small letters."""
    plain = _without_folder(name).lower()
    stem, dot, ending = plain.rpartition(".")
    return stem if dot and len(ending) <= 4 and not ending.isdigit() else plain


def _by_xmp(photos: Sequence[Photo]) -> list[Photo]:
    """The photographs with what XMP adds to EXIF: positions, signs, altitudes."""
    found, only, signs, apart = [], [], [], []
    for photo in photos:
        exif, xmp = photo.exif, photo.exif.xmp_position
        if exif.position is None and xmp is not None:
            only.append(photo.name)
            exif = replace(exif, position=xmp, unsigned=(), no_reference=False)
        elif exif.position is not None:
            position = exif.position
            if exif.unsigned and xmp is not None:
                signed = _like(position, xmp, exif.unsigned)
                if _distance(signed, xmp) < APART_M:
                    signs.append(photo.name)
                    position = signed
                    exif = replace(exif, position=signed, unsigned=())
            if xmp is not None and _distance(position, xmp) > APART_M:
                apart.append(photo.name)
            exif = _altitude_by_xmp(exif)
        found.append(replace(photo, exif=exif))
    if only:
        emit(Warned(f"{len(only)} photographs have their position in XMP only, which is used: {few(only)}"))
    if signs:
        emit(Warned(f"{no_letters(photos)}; the signs are those in XMP: {few(signs)}"))
    if apart:
        emit(
            Warned(
                f"{len(apart)} photographs have positions in EXIF and in XMP that are more than {APART_M:.0f} m apart, "
                f"and those in EXIF are used: {few(apart)}"
            )
        )
    return found


def _altitude_by_xmp(exif: Exif) -> Exif:
    """The altitude of XMP where EXIF has none, or says not which side of its zero it is on."""
    other = exif.xmp_altitude
    if exif.position is None or other is None:
        return exif
    latitude, longitude, altitude = exif.position
    if altitude is not None and (not exif.no_reference or abs(abs(altitude) - abs(other)) > 1):
        return exif
    return replace(exif, position=(latitude, longitude, other), no_reference=False)


def _by_neighbours(photos: Sequence[Photo]) -> list[Photo]:
    """The photographs without letters with the signs of those near by that have them."""
    known = [photo.exif.position for photo in photos if photo.exif.position is not None and not photo.exif.unsigned]
    if not known or len(known) == len(photos):
        return list(photos)
    middle = np.median(np.array(known, np.float64)[:, :2], axis=0)
    like: Position = (float(middle[0]), float(middle[1]), None)
    found, signs = [], []
    for photo in photos:
        exif = photo.exif
        if exif.position is not None and exif.unsigned:
            signed = _like(exif.position, like, exif.unsigned)
            if np.abs(np.subtract(signed[:2], like[:2])).max() < NEAR_DEGREES:
                signs.append(photo.name)
                exif = replace(exif, position=signed, unsigned=())
        found.append(replace(photo, exif=exif))
    if signs:
        emit(Warned(f"{no_letters(photos)}; the signs are those of the photographs near by that have: {few(signs)}"))
    return found


def _heights(photos: Sequence[Photo]) -> list[Photo]:
    """The photographs with altitudes that may be believed; says what was done to them, and how many have none."""
    given = [photo for photo in photos if photo.exif.position is not None]
    places = {photo.name: photo.exif.position for photo in photos if photo.exif.position is not None}
    heights = {name: place[2] for name, place in places.items() if place[2] is not None}
    if len(heights) > 1 and not any(heights.values()):
        emit(Warned(f"the altitudes of all {len(heights)} positions are 0, and count as missing"))
        heights = {}
    if low := [name for name, height in heights.items() if height < LOWEST_M]:
        emit(Warned(f"{len(low)} positions are below any land, and are taken as above their zero: {few(low)}"))
        heights |= {name: -heights[name] for name in low}
    if heights and (middle := float(np.median(list(heights.values())))) < MIN_LAND_M:
        emit(Warned(f"the positions are {-middle:.0f} m below their zero, where little land is: do they count down?"))
    if unsure := [photo.name for photo in given if photo.exif.no_reference and photo.name in heights]:
        emit(
            Warned(
                f"EXIF of {len(unsure)} photographs does not say whether the altitude is above or below sea level "
                f"(GPSAltitudeRef); it is taken as above: {few(unsure)}"
            )
        )
    above = {photo.name: photo.exif.above_start for photo in given if photo.exif.above_start is not None}
    if given and not heights and len(above) == len(given):
        emit(Warned("no position has an altitude: heights are those above the place of the start, by XMP"))
        heights = above
        photos = [replace(photo, exif=replace(photo.exif, zero=None)) for photo in photos]
    elif len(heights) < len(given):
        rest = "; the others place the scene, if they are enough" if heights else ""
        emit(Warned(f"{len(given) - len(heights)} of {len(given)} positions have no altitude{rest}"))
    return [
        photo
        if photo.exif.position is None
        else replace(photo, exif=replace(photo.exif, position=(*photo.exif.position[:2], heights.get(photo.name))))
        for photo in photos
    ]


def no_letters(photos: Sequence[Photo]) -> str:
    """That letters of the hemisphere are missing, in how many photographs and which."""
    lacking = [photo for photo in photos if photo.exif.unsigned]
    which = [LETTERS[axis] for axis in GEODETIC_AXES if any(axis in photo.exif.unsigned for photo in lacking)]
    return f"EXIF of {len(lacking)} photographs has no letter of the hemisphere ({', '.join(which)})"


def _signed(photo: Photo, signs: Mapping[str, int]) -> Photo:
    if photo.exif.position is None or not photo.exif.unsigned:
        return photo
    latitude, longitude = (
        own * signs[axis] if axis in photo.exif.unsigned else own
        for axis, own in zip(GEODETIC_AXES, photo.exif.position[:2], strict=True)
    )
    position = latitude, longitude, photo.exif.position[2]
    return replace(photo, exif=replace(photo.exif, position=position, unsigned=()))


def _like(position: Position, other: Position, axes: Sequence[str]) -> Position:
    """A position with the signs of another, along some axes."""
    latitude, longitude = (
        math.copysign(own, theirs) if axis in axes else own
        for axis, own, theirs in zip(GEODETIC_AXES, position[:2], other[:2], strict=True)
    )
    return latitude, longitude, position[2]


def _distance(one: Position, other: Position) -> float:
    """Metres in plan."""
    return float(np.linalg.norm(geocentric(*one[:2], 0.0) - geocentric(*other[:2], 0.0)))
