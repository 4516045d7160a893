"""Files of splats of any format: which one it is, and what is in it."""

from __future__ import annotations

import difflib
from dataclasses import replace
from pathlib import Path

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.core.registry import components, name_of
from surfkit.io.splats.base import SNIFFED_BYTES, Format
from surfkit.io.splats.file_axes import Axes, AxesOrAuto, FileAxes, in_words, turn_between
from surfkit.io.splats.rotate_splats import turned
from surfkit.io.splats.splat_table import SplatTable

DRAWN_AS = "`surfkit import --drawn-as mip-splatting` draws them as Mip-Splatting, and gof as Gaussian Opacity Fields"
"""What a user can do about splats of which no file says how they are drawn."""


def read_splat_file(path: Path, axes: AxesOrAuto = "auto", flag: str = "--axes rdf") -> SplatTable:
    """The splats of a file of any format, which its content tells, or its name where the content does not.

    Args:
        path: Of the file.
        axes: Of the numbers in it. For auto, those that the file names or its format has; where it is a guess, a
            warning says so.
        flag: What sets `axes` to those of a PLY file.

    Raises:
        BadInput: No such file, of no known format, or damaged.
    """
    table = format_of(path).read(path)
    if table.is_filtered:
        emit(Warned(untold_drawing(path)))
    if axes != "auto":
        return from_axes(table, axes)
    if not table.axes.is_told and len(table):
        emit(Warned(f"{untold_axes(path)}: {assumed_axes(table)}; {flag} takes them as those of a PLY file"))
    return table


def untold_axes(path: Path) -> str:
    """How notes begin about a file whose axes are a guess."""
    return f"{path} does not say which axes its numbers have"


def untold_drawing(path: Path, remedy: str = DRAWN_AS) -> str:
    """The note on a file of Mip-Splatting or Gaussian Opacity Fields, which draw otherwise than 3DGS.

    Args:
        path: Of the file.
        remedy: What says how its splats are drawn.
    """
    return (
        f"{path}: its column filter_3D is applied; nothing says how its splats are drawn, so they are taken as those "
        f"of 3DGS; {remedy}"
    )


def assumed_axes(table: SplatTable) -> str:
    """Which axes the reader of a file has assumed."""
    return f"{table.axes.name} ({in_words(table.axes.name)}) is assumed"


def from_axes(table: SplatTable, axes: Axes) -> SplatTable:
    """The splats of a file whose numbers have these axes, in place of those that its reader took."""
    turn = turn_between(axes) @ turn_between(table.axes.name).T
    return replace(turned(table, turn), axes=FileAxes(axes))


def format_of(path: Path) -> Format:
    """The format of a file that is there.

    Raises:
        BadInput: No such file, or of no known format.
    """
    path = Path(path)
    head = b""
    try:
        if not path.is_dir():
            if path.exists() and not path.is_file():  # a pipe would wait for someone to write
                raise BadInput(f"{path}: neither a file nor a folder; name a file of splats")
            with path.open("rb") as file:
                head = file.read(SNIFFED_BYTES)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}") from error
    known = [cls() for cls in components(Format).values()]
    found = [form for form in known if form.knows(path, head)]
    if not found:
        raise BadInput(f"{path}: no file of splats of a known format; known: {_listed(known)}")
    by_content = [form for form in found if form.knows(path.with_name("content"), head)]  # whatever it is called
    return max(by_content or found, key=lambda form: has_suffix(path, form))


def format_for(path: Path) -> Format:
    """The format that the name of a file to be written asks for.

    Raises:
        BadInput: No format has this suffix.
    """
    known = [cls() for cls in components(Format).values()]
    found = [form for form in known if form.suffix and has_suffix(path, form)]
    if not found:
        near = difflib.get_close_matches(path.suffix.lower(), [form.suffix for form in known if form.suffix], n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise BadInput(
            f"{path}: no format of splats has this suffix; {meant}known: {_listed(known)}; or give --format NAME"
        )
    return max(found, key=lambda form: len(form.suffix))  # .compressed.ply ends in .ply too


def has_suffix(path: Path, form: Format) -> bool:
    """Whether the name of a file ends as those of a format do."""
    return path.name.lower().endswith(form.suffix)


def _listed(known: list[Format]) -> str:
    return ", ".join(f"{name_of(form)} ({form.suffix or 'a folder'})" for form in known)
