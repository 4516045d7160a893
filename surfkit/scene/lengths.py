"""Lengths of settings in metres or `auto`, and what they are in the local frame."""

from __future__ import annotations

from typing import Literal

from surfkit.core.check import BadInput
from surfkit.scene.crs import known_axes
from surfkit.scene.scene import Frame

Length = float | Literal["auto"]


def check_length(name: str, value: Length) -> None:
    """BadInput for a length that is not one."""
    if value != "auto" and not 0 < value < float("inf"):
        raise BadInput(f"{name} is {value:g}; it must be more than 0 metres, or auto")


def unit_of(frame: Frame) -> str:
    """What lengths in the frame of the input are called behind numbers: m, ft, US ft, km; "units" if nobody knows."""
    if frame.crs is not None and (axes := known_axes(frame.crs)) is not None:
        return axes.symbol
    return "m" if frame.metres == 1 else "units"


def to_local(value: Length, frame: Frame, where: str = "") -> float | None:
    """A length in metres in local units; None if it is automatic. Messages begin with `where`."""
    if value == "auto":
        return None
    if frame.local_metres is None:
        raise BadInput(
            f"{where}a length of {value:g} m cannot be used: the data set does not say how long its unit is; give "
            "--metres-per-unit (1 if its coordinates are metres), or leave the length at auto"
        )
    return value / frame.local_metres
