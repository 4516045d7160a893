"""Numbers in words of a report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surfkit.apps.report.json_values import NO_VALUE

SQUARE_METRES = ((1e6, "km²"), (1e4, "ha"), (1.0, "m²"))


def length(value: float | None, unit: str) -> str:
    """A length with three significant digits, in centimetres or millimetres where it is a short one in metres."""
    if value is None or not np.isfinite(value):
        return NO_VALUE
    if unit == "m" and abs(value) < 1 and value:
        return f"{100 * value:.3g} cm" if abs(value) >= 0.01 else f"{1000 * value:.3g} mm"
    return f"{value:.3g} {unit}"


def fixed(value: float | None, digits: int) -> str:
    """A number with so many digits after the point; a dash for none."""
    if value is None or not np.isfinite(value):
        return NO_VALUE
    return f"{round(value, digits) + 0.0:,.{digits}f}"  # + 0.0: no -0.000


def area(square_units: float, metres: float | None) -> str:
    """An area, given in squares of a unit of so many metres."""
    if metres is None:
        return f"{square_units:,.4g} square units"
    size = square_units * metres**2
    by, unit = next((pair for pair in SQUARE_METRES if size >= 0.1 * pair[0]), SQUARE_METRES[-1])
    also = f" ({size / 1e4:,.4g} ha)" if unit == "km²" else ""
    return f"{size / by:,.3g} {unit}{also}"


def share(part: float, whole: float) -> str:
    """A share in percent."""
    return f"{100 * part / whole:.1f} %" if whole else NO_VALUE


def moments(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard deviation and root mean square of (N, K) values, (K,) each."""
    spread = rows.std(0, ddof=1) if len(rows) > 1 else np.full(rows.shape[1], np.nan)
    return rows.mean(0), spread, np.sqrt((rows**2).mean(0))


def day(time: str) -> str:
    """The day of a time as EXIF writes it, 2024:05:01 12:00:00, as 2024-05-01."""
    return time[:10].replace(":", "-")


def days(times: Sequence[str]) -> str:
    """The first and the last day of some times, in their order."""
    first, last = day(times[0]), day(times[-1])
    return first if first == last else f"{first} to {last}"
