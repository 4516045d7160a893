"""Volumes as they are printed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from surfkit.cli.console_table import print_table

LEAST_TOLD = 0.01
"""Share of a polygon without expected errors from which on the table tells of it."""


def show_volumes(volumes: Sequence[dict[str, Any]], unit: str) -> None:
    """Print a table of volumes; each is what maps.json says of a polygon, and the unit that of lengths."""
    units = f"{unit}, {unit}², {unit}³"
    fitted, dates = volumes[0]["base_error"] is not None, volumes[0]["fill_since"] is not None
    head = [f"polygon ({units})", "area", "no surface", "base", "base at", "fill", "cut", "net", "mean height"]
    sure = volumes[0]["surface_error"] is not None
    head += ["highest", *(["error of base"] if fitted else []), *(["error of surface, at most"] if sure else [])]
    rows = [
        [
            each["name"], f"{each['area']:,.6g}", f"{each['without_surface']:.1%}", each["base"], _span(each),
            f"{each['fill']:,.6g}", f"{each['cut']:,.6g}", f"{each['net']:,.6g}", f"{each['mean_height']:.4g}",
            f"{each['highest']:.4g}", *([f"{each['base_error']:,.3g}"] if fitted else []),
            *([_error(each)] if sure else []),
        ]
        for each in volumes
    ]  # fmt: skip
    print_table(head, rows)
    if dates:
        print()
        head = [f"changes ({units})", "compared", "changed", "fill", "cut", "net"]
        names = ("compared", "changed", "fill_since", "cut_since", "net_since")
        print_table(head, [[each["name"], *(f"{each[name]:,.6g}" for name in names)] for each in volumes])


def _error(each: dict[str, Any]) -> str:
    """By how much expected errors of heights may change a volume; and the share of it of which they are not known."""
    open_ = f" + {each['without_precision']:.0%} not known" if each["without_precision"] >= LEAST_TOLD else ""
    return f"{each['surface_error']:,.3g}{open_}"


def _span(each: dict[str, Any]) -> str:
    """The height of a base, or its least and its greatest."""
    low, high = f"{each['base_lowest']:.2f}", f"{each['base_highest']:.2f}"
    return low if low == high else f"{low} to {high}"
