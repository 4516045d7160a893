"""A text file of points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from surfkit.plugin import BadInput, Format, Frame, SplatTable, Tile, replacing

SH0 = 0.28209479177387814
"""The spherical harmonic of degree 0: a colour is 0.5 + SH0 x coefficient."""


@dataclass(frozen=True)
class NewPart(Format):
    """Text with a line `x y z red green blue` for each splat that is opaque enough; it is written, and not read."""

    suffix: ClassVar[str] = ".xyz"

    least: float = 0.5
    """Opacity below which a splat is left out."""

    def __post_init__(self) -> None:
        if not 0 <= self.least < 1:
            raise BadInput(f"new-part.least is {self.least}; it must be 0 or more and below 1")

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`. Coordinates have twelve digits, so they are written with the shift of the frame."""
        table.refuse_unsound(path)
        kept = table.opacity_logits.detach().cpu().sigmoid() >= self.least
        places = table.means.detach().cpu()[kept].double().numpy()
        colors = 0.5 + SH0 * table.sh0.detach().cpu()[kept].double().numpy()
        with replacing(path) as file:
            rows = np.concatenate([places, np.rint(255 * colors.clip(0, 1))], axis=1)
            np.savetxt(file, rows, fmt=["%.12g"] * 3 + ["%d"] * 3)

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        return f"positions and colours only, without the splats whose opacity is below {self.least:g}"
