"""A command of surfkit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import surfkit
import tyro


@dataclass(frozen=True)
class NewPart:
    """Count the splats of a run by their opacity."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    faint: float = 0.05
    """Opacity below which a splat is faint."""

    def __post_init__(self) -> None:
        if not 0 < self.faint < 1:
            raise surfkit.BadInput(f"--faint {self.faint}: give more than 0 and less than 1")

    def run(self) -> None:
        """Print how many splats there are, and how many of them are faint."""
        with surfkit.open(self.out) as run:
            opacities = run.splats.opacities
        print(f"{len(opacities)} splats, {int((opacities < self.faint).sum())} of them faint")


COMMAND = NewPart
