"""A page for a browser: one HTML file with the splats and what shows them, which loads nothing else.

The splats are SPZ data of version 3 in base64, in units of the page about the middle of the scene: input =
centre + unit x page. The script, page.js, decodes and draws them.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from surfkit.core.check import require_within
from surfkit.core.events import Warned, emit
from surfkit.core.files import replacing
from surfkit.core.version import own_version
from surfkit.io.splats.base import Format
from surfkit.io.splats.rotate_splats import turned
from surfkit.io.splats.splat_table import SplatTable, Tile
from surfkit.io.splats.spz import SPZ, spz_bytes
from surfkit.scene.scene import Frame, View

EXTENT_SPLAT_SHARE = 0.9
"""Share of the splats within the extent of a page."""
PAGE_RADIUS_UNITS = 64.0
"""Units of the page: half of what the scene takes. Scales of SPZ, 4.5e-5 to 380, lie well about it."""
MAX_PAGE_VIEWS = 64
"""Places of photographs that the page knows, evenly spaced."""
MAX_DISTANCE_SPLATS = 20_000
"""Splats by which it is found how far ahead of a camera the scene lies."""
MIN_UPWARD_SINE = 0.9
"""Sine of the elevation from which on a view looks up: at the sky, or a ceiling."""
FILL_CELLS_PER_SIDE = 16
"""Parts of each side of a picture, by which it is found how much of it is filled."""
DEFAULT_FOCAL_HEIGHTS = 1.0
"""Focal length in heights of the picture where no camera is known: 53 degrees."""


@dataclass(frozen=True)
class HtmlPageFormat(Format):
    """One HTML file that shows the splats in any browser of today, without a network: to be mailed or put on a site."""

    suffix: ClassVar[str] = ".html"

    max_splats: int = 500_000
    """Most splats in the page; of more, those are kept of which most is seen: the most opaque and largest. A splat
    takes about 25 bytes."""

    sh_degree: Literal[0, 1] = 1
    """Degree of the spherical harmonics: 0 leaves out how colours change with the direction of view, and makes the file
    about a third smaller."""

    def __post_init__(self) -> None:
        require_within({"max_splats": (1, 4_000_000)}, self)

    def write(self, path: Path, table: SplatTable, frame: Frame | None = None, tree: Tile | None = None) -> None:
        """See `Format.write`. The page begins with a look at the whole."""
        self.write_seen(path, table, frame, (), None)

    def write_seen(
        self, path: Path, table: SplatTable, frame: Frame | None, views: Sequence[View], up: np.ndarray | None
    ) -> None:
        """Write a page that begins where a photograph was taken.

        Args:
            path: Appears only when it is complete.
            table: See `Format.write`.
            frame: See `Format.write`; needed for views, which are in its local frame.
            views: The page begins at that which shows most; its keys lead to the others.
            up: (3,) unit vector; None for z on a map, and -y elsewhere.

        Raises:
            BadInput: See `Format.write`.
        """
        table.refuse_unsound(path)
        kept = self.kept(table.on_cpu())
        if len(kept) < len(table):
            share = f"the {len(kept):,} of {len(table):,} splats are kept of which most is seen"
            emit(Warned(f"{path}: {share}; --format.max-splats keeps more in a larger file"))
        kept = replace(kept, sh_rest=kept.sh_rest[:, : (self.sh_degree + 1) ** 2 - 1])
        means = kept.means.double().numpy()
        centre = np.median(means, axis=0) if len(means) else np.zeros(3)
        reach = float(np.quantile(np.linalg.norm(means - centre, axis=1), EXTENT_SPLAT_SHARE)) if len(means) else 0.0
        unit = reach / PAGE_RADIUS_UNITS or 1.0
        here = turned(replace(kept, means=kept.means.double() - torch.from_numpy(centre)), np.eye(3), 1 / unit)
        if up is None:
            up = np.array([0.0, 0.0, 1.0]) if frame is not None and frame.crs else np.array([0.0, -1.0, 0.0])
        seen = [_place(view, frame, centre, unit, here) for view in views[:: max(1, -(-len(views) // MAX_PAGE_VIEWS))]]
        facts = {
            "title": path.stem,
            "told": f"{len(kept):,} splats" + (f" of {len(table):,}" if len(kept) < len(table) else ""),
            "centre": centre.tolist(),
            "unit": unit,
            "discs": kept.kind == "surfel",
            "up": up.tolist(),
            "start": max(range(len(seen)), key=lambda at: _fit_to_begin(seen[at], up), default=0),
            "views": seen or [_overview(up)],
        }
        with replacing(path) as file:
            file.write(_filled(path.stem, facts, spz_bytes(here, 3, path)).encode())

    def kept(self, table: SplatTable) -> SplatTable:
        """See `Format.kept`."""
        if len(table) <= self.max_splats:
            return table
        return table.take(table.shown().topk(self.max_splats).indices.sort().values)

    def rounding(self, table: SplatTable) -> str:
        """See `Format.rounding`."""
        left_out = table.sh_degree > self.sh_degree
        harmonics = f"spherical harmonics above degree {self.sh_degree} are left out; " if left_out else ""
        return harmonics + SPZ().rounding(replace(table, sh_rest=table.sh_rest[:, : 3 * self.sh_degree]))


def _place(view: View, frame: Frame | None, centre: np.ndarray, unit: float, here: SplatTable) -> dict[str, Any]:
    """Where a photograph was taken, in the units of the page, how far ahead the scene lies, and how much it shows.

    That is the share of the splats times that of the picture where there are some: a page that began at the rim of a
    survey would be half empty.
    """
    assert frame is not None
    pose = frame.input_pose(view.camera.world_to_camera)
    turn = pose[:3, :3]
    eye = (-turn.T @ pose[:3, 3] - centre) / unit
    few = here.means[:: max(1, len(here) // MAX_DISTANCE_SPLATS)].double().numpy()
    x, y, z = ((few - eye) @ turn.T).T
    camera = view.camera
    inside = (z > 0) & (np.abs(x) * camera.fx < z * camera.width / 2) & (np.abs(y) * camera.fy < z * camera.height / 2)
    away = float(np.median(z[inside])) if inside.any() else PAGE_RADIUS_UNITS
    steps = [
        (side[inside] / z[inside] * focal / length + 0.5) * FILL_CELLS_PER_SIDE
        for side, focal, length in ((x, camera.fx, camera.width), (y, camera.fy, camera.height))
    ]
    filled = len(np.unique(np.stack(steps, 1).astype(int), axis=0)) / FILL_CELLS_PER_SIDE**2
    shape = {"focal": camera.fy / camera.height, "aspect": camera.width / camera.height}
    place = {"eye": eye.tolist(), "turn": turn.ravel().tolist(), "away": away}
    return {"name": view.name, **place, **shape, "shown": filled * float(inside.mean()) if len(few) else 0.0}


def _fit_to_begin(place: dict[str, Any], up: np.ndarray) -> tuple[bool, float]:
    """The higher, the better a page begins there: first of all, it does not look up, as one view of a panorama does."""
    return bool(np.reshape(place["turn"], (3, 3))[2] @ up < MIN_UPWARD_SINE), place["shown"]


def _overview(up: np.ndarray) -> dict[str, Any]:
    """A look at the whole from obliquely above."""
    side = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    side /= np.linalg.norm(side)
    forward = np.cross(up, side) - 0.7 * up
    forward /= np.linalg.norm(forward)
    away = 2.5 * PAGE_RADIUS_UNITS
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    turn = np.stack([right, np.cross(forward, right), forward])
    place = {"eye": (-away * forward).tolist(), "turn": turn.ravel().tolist(), "away": away}
    return {"name": "", **place, "focal": DEFAULT_FOCAL_HEIGHTS, "aspect": 1.0}


def _filled(title: str, facts: dict[str, Any], splats: bytes) -> str:
    """The page. Nothing in what is filled in can end the element that it stands in."""
    here = Path(__file__)
    parts = {
        "generator": html.escape(f"surfkit {own_version()}"),
        "title": html.escape(title),
        "facts": json.dumps(facts).replace("<", "\\u003c"),
        "splats": base64.b64encode(splats).decode(),
        "script": here.with_name("page.js").read_text(encoding="utf-8").strip(),
    }
    first, *rest = here.with_name("page.html").read_text(encoding="utf-8").split("{{")
    filled = [first]
    for piece in rest:
        name, _, text = piece.partition("}}")
        filled += [parts[name], text]
    return "".join(filled)
