"""`surfkit view`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from surfkit.apps.view.server import LOCAL, Address, refuse_wrong_port, require_viser, served
from surfkit.apps.view.shared_cache import DEFAULT_BUDGET, Form
from surfkit.apps.view.viewer_page import show
from surfkit.apps.view.viewer_scene import opened_subject
from surfkit.core.check import BadInput, printable
from surfkit.io.splats.file_axes import AxesOrAuto
from surfkit.raster.select import Device
from surfkit.runs.run_notes import collect_notes

Up = Literal["x", "-x", "y", "-y", "z", "-z"]
AWAKE_S = 0.2
"""The main thread looks this often for a Ctrl-C that the system handed to another thread, which does not wake it."""


@dataclass(frozen=True)
class ViewCommand:
    """Look at a finished run, or at a file of splats, a mesh or points, in a browser on this machine.

    Splats, mesh, cameras with their photographs, blocks, depth, normals and errors; measuring in the units of the data
    set; a crop box for `surfkit mesh` and a path for `surfkit render`. The address that is printed ends in a random
    token: without it, nothing is served. Ctrl-C ends it. Needs `pip install 'surfkit[view]'`.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder that `surfkit train` made; or a file of splats of any program, a mesh (PLY, GLB, OBJ), or points (PLY,
    LAS, LAZ)."""

    out: Path | None = None
    """Folder for crop boxes and paths. Default: RUN/view, or FILE-view beside the file."""

    most: int = DEFAULT_BUDGET
    """Splats, triangles and points that are sent to a browser at first; sliders on the page change it."""

    draw: Form | None = None
    """How splats are drawn at first. Default: splats, but points in a browser without a graphics card. With
    points-while-moving, splats come back when the camera rests."""

    up: Up | None = None
    """Axis of the data set that points up. Default: what a run or a file tells; -y in a file of splats that tells
    nothing."""

    axes: AxesOrAuto = "auto"
    """Axes of the numbers in a file of splats, as SPZ names them: rdf for right, down, forward, those of a PLY file.
    auto: those that the file names, or that its format has."""

    host: str = LOCAL
    """Address to serve at. 0.0.0.0 lets other machines connect, if they have the token; nothing is encrypted."""

    port: int | None = None
    """Port to serve at. Default: the first free one from 8080 on."""

    open: bool = True
    """Open the page in a browser, if this machine has a display."""

    device: Device = "auto"
    """Device for rendering: auto, cpu, cuda, cuda:1, or a rasterizer by its name (`surfkit components rasterizer`)."""

    def __post_init__(self) -> None:
        refuse_wrong_port(self.port, "--port")
        if self.most < 1:
            raise BadInput(f"--most {self.most}: give 1 or more")
        if self.out is not None and self.out.is_file():
            raise BadInput(f"--out {self.out}: a file; name a folder")

    @property
    def folder(self) -> Path:
        """For the files that a user writes on the page."""
        if self.out is not None:
            return self.out
        return self.source / "view" if self.source.is_dir() else self.source.with_name(f"{self.source.name}-view")

    def run(self) -> None:
        """Serve until Ctrl-C."""
        require_viser()
        address = Address(self.host, self.port)
        with collect_notes(), opened_subject(self.source, self.device, self.axes) as subject:
            if self.up is not None:
                direction = np.eye(3)["xyz".index(self.up[-1])]
                subject = replace(subject, up=-direction if self.up.startswith("-") else direction)
            with served(address, f"surfkit: {self.source.resolve().name}") as page:
                show(subject, page, self.folder, self.most, self.draw)
                print(f"{printable(str(self.source))} is shown at\n\n    {page.url}\n\nCtrl-C ends it.", flush=True)
                if not address.is_local:
                    print("Whoever has this address can look; what is sent is not encrypted.", flush=True)
                if self.open:
                    page.open_browser()
                try:
                    while not page.closing.wait(AWAKE_S):
                        pass
                except KeyboardInterrupt:
                    print("\nended")


COMMAND = ViewCommand
