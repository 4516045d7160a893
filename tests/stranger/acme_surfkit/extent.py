"""A command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import surfkit


@dataclass(frozen=True)
class Extent:
    """Print the box of the splats of a run, in the coordinates of its data set."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `surfkit train` made."""

    def run(self) -> None:
        """Print the lowest and the highest corner."""
        with surfkit.open(self.out) as run:
            means = run.splats.means
        for corner in (means.amin(0), means.amax(0)):
            print(*(f"{value:.3f}" for value in corner.tolist()))
